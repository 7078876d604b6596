"""Acceptance test of an estimator trained on one record: replays on that record and on others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.metrics import DIVERGED
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.initial_set import prior_moments

OTHER_SEEDS = (0, 1)
"""Seeds of the episodes with other initial states, where the setup draws these."""
ELSEWHERE = 10
"""Number of episodes of the set on which an estimator is judged, of the seeds from 0 on."""
_WORTH = 0.5
"""Median error over that of the model alone up to which an estimator is worth something."""
_BETTER = 0.95
"""The same, up to which it is worth little; above, it is worth nothing."""
SMALL_LOSS = 1e-5
"""Training loss below which a good observer would be expected."""


@dataclass(frozen=True)
class Replay:
    """An estimator run on one episode."""

    name: str
    """The episode's relation to the training record."""
    played: Played
    """The result, of one episode."""

    @property
    def scores(self) -> Row:
        """The scores of the episode; see `pinnobs_gym.scoring.metrics.score`."""
        return self.played.scores.rows()[0]


def replays(estimator: BaseEstimator, game: Game, seed: int) -> list[Replay]:
    """Run an estimator on the record of that seed, on one from the same initial state with new
    output noise of the benchmark's standard deviation, and on two from other initial states.

    The latter are the episodes of seeds 0 and 1. If the setup has a single initial state x₀, they
    start at x̂₀ + (x₀ − x̂₀)/2 and x̂₀ − (x₀ − x̂₀)/2, both with the same x̂₀.
    """
    source, system = game.source, game.source.system
    own = play(game, estimator, [seed])
    x0 = own.truth[0, 0]
    noise_std = system.setups["benchmark"].noise_std
    noisy = Game.of(game.system, game.name.setup, game.name.condition, noise_std=noise_std)
    fresh = play(noisy, estimator, [seed + 1], x0[None])
    replayed = [Replay("own record", own), Replay("fresh noise", fresh)]
    if not source.fixed_x0:
        others = [Replay(f"episode {k}", play(game, estimator, [k])) for k in OTHER_SEEDS]
        return replayed + others
    xhat0, _ = prior_moments(system, source.setup)
    for sign in (0.5, -0.5):
        other = xhat0 + sign * (x0 - xhat0)
        name = "x0=[" + ", ".join(f"{v:g}" for v in other) + "]"
        replayed.append(Replay(name, play(game, estimator, [seed], other[None])))
    return replayed


def warning(loss: float, own: Row) -> str | None:
    """Return a one-line warning if the loss is small but the replay of the training record
    diverges, else None.

    Args:
        loss: of the training.
        own: the scores of the replay on the training record.
    """
    if not loss < SMALL_LOSS or own["nrmse"] <= DIVERGED:
        return None
    return (
        f"the loss of {loss:.2g} tells nothing here: between t0 and the first sample no residual "
        "is taken, x̂ jumps there to the trajectory, and the gain is arbitrary"
    )


@dataclass(frozen=True)
class Elsewhere:
    """What an estimator that was trained on one record is worth on others."""

    nrmse: float
    """Median NRMSE over the episodes; infinite if most are not finite."""
    alone: float
    """Median NRMSE of the model alone, from the same initial estimates."""
    diverged: int
    """Number of episodes in which the estimator diverged."""
    episodes: int
    """Number of episodes."""

    @property
    def worth(self) -> bool:
        """Whether it diverges nowhere, and halves the error of the model alone."""
        return self.diverged == 0 and self.nrmse <= _WORTH * self.alone

    @property
    def line(self) -> str:
        """All of this in one line."""
        better = self.diverged == 0 and self.nrmse <= _BETTER * self.alone
        verdict = "something" if self.worth else "little" if better else "nothing"
        return (
            f"worth {verdict} on other records: of {self.episodes} from the initial set "
            f"{self.diverged} diverged, median NRMSE {self.nrmse:.3g}, the model alone "
            f"{self.alone:.3g}"
        )


def elsewhere(estimator: BaseEstimator, game: Game) -> Elsewhere | None:
    """Run an estimator on episodes of a game from initial states of its set, and the model alone.

    If the setup has a single initial state, the states are those of the setup ``benchmark``; None
    if this has a single one, too.
    """
    source, seeds, x0 = game.source, range(ELSEWHERE), None
    if source.fixed_x0:
        benchmark = Game.of(game.system, "benchmark")
        if benchmark.source.fixed_x0:
            return None
        x0 = benchmark.episodes(seeds).x[0]
    model = ESTIMATORS.resolve("open_loop").for_setup(source.system, source.setup)
    own, alone = (play(game, one, seeds, x0).scores_alone for one in (estimator, model))
    with np.errstate(over="ignore"):  # errors of what diverges may be huge
        nrmse, of_model = (
            float(np.median(np.nan_to_num(each.nrmse, nan=np.inf))) for each in (own, alone)
        )
    return Elsewhere(nrmse, of_model, int(np.sum(own.diverged)), ELSEWHERE)
