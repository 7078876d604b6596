"""Conditions of the start: another initial state or another initial estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.conditions.base import Condition
from pinnobs_gym.simulation.system import Setup, System, vector


@dataclass(frozen=True)
class FarGuess(Condition):
    """An initial estimate further away: each component is moved by one prior standard deviation
    away from the middle of the initial set. P₀ is unchanged."""

    reference = False
    known_to_estimators = "x̂₀"

    @property
    def summary(self) -> str:
        return "x̂₀ moved by √P₀ away from the middle of the initial set"

    def setup(self, system: System, setup: Setup) -> Setup:
        low, high, xhat0, P0_std = (
            vector(getattr(setup, name), system.nx, name)
            for name in ("x0_low", "x0_high", "xhat0", "P0_std")
        )
        away = np.where(xhat0 >= (low + high) / 2, 1.0, -1.0)
        return replace(setup, xhat0=tuple((xhat0 + away * P0_std).tolist()))


@dataclass(frozen=True)
class OutsideSet(Condition):
    """Initial states outside the setup's set: states of the set times a factor, of which only those
    outside the set are used."""

    factor: float = 1.5
    reference = False

    @property
    def summary(self) -> str:
        return f"x₀ outside the initial set: {self.factor:g} times a state of it"

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        x0 = self.factor * x0
        return x0[~inside(x0)]
