"""What a gain trained on one record is worth: replays on that record and on others."""

from __future__ import annotations

from dataclasses import dataclass

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.scoring.metrics import DIVERGED
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.system import vector

OTHER_SEEDS = (0, 1)
"""Episodes of other initial states, where the setup draws these."""
SMALL_LOSS = 1e-5
"""A loss under which one would expect a good observer."""


@dataclass(frozen=True)
class Replay:
    """An estimator run on an episode."""

    name: str
    """What the episode is, beside the record that was trained on."""
    played: Played
    """The one episode."""

    @property
    def scores(self) -> Row:
        """See `pinnobs_gym.scoring.metrics.score`."""
        return self.played.scores.rows()[0]


def replays(estimator: BaseEstimator, game: Game, seed: int) -> list[Replay]:
    """Run an estimator on the record of that seed; on one from the same initial state with fresh
    output noise of the benchmark's size; and on two from other initial states.

    These are the episodes of seeds 0 and 1 or, where the setup has but one initial state x₀,
    episodes from x̂₀ + (x₀ − x̂₀)/2 and x̂₀ − (x₀ − x̂₀)/2, all from the same x̂₀.
    """
    source, system = game.source, game.source.system
    own = play(game, estimator, [seed])
    x0 = own.truth[0, 0]
    noise_std = system.setups["benchmark"].noise_std
    noisy = Game.of(game.system, game.name.setup, game.name.condition, noise_std=noise_std)
    fresh = play(noisy, estimator, [seed + 1], x0[None])
    found = [Replay("own record", own), Replay("fresh noise", fresh)]
    if not source.fixed_x0:
        others = [Replay(f"episode {k}", play(game, estimator, [k])) for k in OTHER_SEEDS]
        return found + others
    xhat0 = vector(source.setup.xhat0, system.nx, "xhat0")
    for sign in (0.5, -0.5):
        other = xhat0 + sign * (x0 - xhat0)
        name = "x0=[" + ", ".join(f"{v:g}" for v in other) + "]"
        found.append(Replay(name, play(game, estimator, [seed], other[None])))
    return found


def warning(loss: float, own: Row) -> str | None:
    """What a small loss with a bad replay of its own record means, in a line; None if it is not so.

    Args:
        loss: of the training.
        own: the scores of the replay on the record that was trained on.
    """
    if not loss < SMALL_LOSS or own["nrmse"] <= DIVERGED:
        return None
    return (
        f"the loss of {loss:.2g} tells nothing here: between t0 and the first sample no residual "
        "is taken, x̂ jumps there to the trajectory, and the gain is arbitrary"
    )
