"""Whether an episode has one score, played alone or in a batch."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.evaluation import make_estimator
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.systems import SYSTEMS

EPISODES = 7
"""Number of episodes that are compared, of seeds 0, 1, ..."""
BATCHES = (7, 60, 256)
"""Sizes of the batches that begin with these episodes."""
SAMPLES = 40
"""Number of samples of an episode: a fraction of the benchmark's, to limit the time."""


def differences() -> dict[str, float]:
    """Return, for each estimator that needs no training, the largest relative difference between
    the scores of an episode played alone and in a batch, over all systems without a condition."""
    return {name: max(_differences(name)) for name in untrained()}


def untrained() -> list[str]:
    """Return the names of the estimators that need no training."""
    return [
        name
        for name, cls in ESTIMATORS.classes().items()
        if cls.needs_training is None and cls.trains_on_record is None
    ]


def _differences(name: str) -> Iterator[float]:
    """Yield the differences of an estimator's scores, of every system, batch and episode."""
    for cls in SYSTEMS.classes().values():
        game = Game.of(env_id(cls), duration=SAMPLES * cls.setups["benchmark"].dt)
        estimator = make_estimator(name, game, {})
        alone = [play(game, estimator, [seed]).scores.rows()[0] for seed in range(EPISODES)]
        for size in BATCHES:
            together = play(game, estimator, range(size)).scores.rows()
            for one, other in zip(alone, together, strict=False):
                yield difference(one, other)


def difference(one: Mapping[str, Any], other: Mapping[str, Any]) -> float:
    """Return the largest relative difference between the scores of two rows; infinite where only
    one of them has a score, or it is finite in one of them only."""
    found = [_relative(one[name], other[name]) for name in one if name != "state_rmse"]
    for window, errors in one["state_rmse"].items():
        found += [_relative(errors[name], other["state_rmse"][window][name]) for name in errors]
    return max(found)


def _relative(a: float | None, b: float | None) -> float:
    if a == b:
        return 0.0
    if a is None or b is None or not (math.isfinite(a) and math.isfinite(b)):
        return math.inf
    return abs(a - b) / max(abs(a), abs(b))
