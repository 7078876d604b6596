"""Settings of the trainer of beliefs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from pinnobs_gym.training.settings import TrainingConfig, check_setting, check_whole

HELD_OUT = 4
"""Every condition with a number divisible by this is held out; a training has one at least."""
Supervision: TypeAlias = Literal["states", "outputs"]
"""What the densities that are maximised are of."""


@dataclass(frozen=True)
class RobustGainConfig(TrainingConfig):
    """Settings of beliefs that are learned on simulations under random conditions."""

    may_change = ("iterations",)

    supervision: Supervision = "states"
    """What the beliefs are judged by: the density of the simulated true states (states), or that of
    the outputs (outputs)."""
    iterations: int = 32
    """Number of random conditions, of `per_condition` episodes each; every fourth is held out."""
    per_condition: int = 6
    """Episodes under each condition."""
    trust: float = 0.93
    """Probability that the model is right, but for noise and missing outputs of any amount."""
    near: int = 16
    """Parts into which the initial set is divided."""
    wide: int = 8
    """Parts into which a Gaussian law about x̂₀ is divided, for initial states outside the set."""
    spread: float = 1.7
    """Standard deviation of that law, in those of the prior."""
    noise_levels: tuple[float, ...] = (0.01, 0.03, 0.1, 0.3, 1.0)
    """Process noise of the beliefs, as `GaussianEstimator.assumed_noise`."""
    deviation: tuple[float, ...] = (0.1, 0.2)
    """Standard deviations of relative deviations of the plant from the model."""
    outliers: float = 0.02
    """Probability of outliers under the beliefs that there are some."""
    leak: float = 1e-6
    """Part of the probabilities that returns to those before the first sample, at each sample."""
    checkpoint_every: int = 4
    """Iterations between checkpoints."""
    log_every: int = 1
    """Iterations between points of the logged curves."""

    @property
    def recipe(self) -> str:
        return "outputs only" if self.supervision == "outputs" else ""

    @property
    def records(self) -> int:
        return 0

    def __post_init__(self) -> None:
        self.check_shared()
        check_whole(self, ("per_condition", "near", "wide"))
        check_whole(self, ("iterations",), least=HELD_OUT)
        check_setting(self, "spread", "a number of at least 1", lambda v: 1 <= v < math.inf)
        for name in ("trust", "outliers"):
            check_setting(self, name, "a number between 0 and 1", lambda v: 0 < v < 1)
        check_setting(self, "leak", "a number from 0 to below 1", lambda v: 0 <= v < 1)
        for name in ("noise_levels", "deviation"):
            expected = "ascending numbers above 0"
            check_setting(self, name, expected, lambda v: _ascending(v))


def _ascending(values: tuple[float, ...]) -> bool:
    return all(a < b for a, b in zip((0.0, *values), (*values, math.inf), strict=True))


def from_outputs() -> RobustGainConfig:
    """The beliefs that make simulated outputs most probable; no true state is used."""
    return RobustGainConfig(supervision="outputs")
