"""What a gain trained on one record is worth: replays on that record and on others."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.envs.registration import make_vector_env
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.scoring.metrics import DIVERGED
from pinnobs_gym.scoring.playing import score_batch
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
    scores: Row
    """See `pinnobs_gym.scoring.metrics.score`."""


def replays(
    estimator: Estimator, env_id: str, setup: str, condition: str, seed: int
) -> tuple[list[Replay], dict[str, Any]]:
    """Run an estimator on the record of that seed; on one from the same initial state with fresh
    output noise of the benchmark's size; and on two from other initial states.

    These are the episodes of seeds 0 and 1 or, where the setup has but one initial state x₀,
    episodes from x̂₀ + (x₀ − x̂₀)/2 and x̂₀ − (x₀ − x̂₀)/2, all from the same x̂₀.

    Returns:
        The four replays, and what `pinnobs_gym.envs.figures.state_figure` draws of the first.
    """
    source = make_vector_env(env_id, 1, setup, condition).source

    def replay(name: str, seed: int, x0: np.ndarray | None = None, **changes: Any) -> Replay:
        options = None if x0 is None else {"x0": x0}
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message=".*outside the initial set")
            scores, _ = score_batch(estimator, env_id, setup, condition, [seed], options, **changes)
        return Replay(name, scores[0])

    own, example = score_batch(estimator, env_id, setup, condition, [seed])
    x0 = example["x"][0]
    noise = source.system.setups["benchmark"].noise_std
    found = [Replay("own record", own[0]), replay("fresh noise", seed + 1, x0, noise_std=noise)]
    if source.fixed_x0:
        xhat0 = vector(source.setup.xhat0, source.system.nx, "xhat0")
        for sign in (0.5, -0.5):
            other = xhat0 + sign * (x0 - xhat0)
            name = "x0=[" + ", ".join(f"{v:g}" for v in other) + "]"
            found.append(replay(name, seed, other))
    else:
        found += [replay(f"episode {other}", other) for other in OTHER_SEEDS]
    return found, example


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
