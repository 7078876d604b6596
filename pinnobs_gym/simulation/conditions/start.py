"""Conditions of the start: another initial state or another initial estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.conditions.base import Condition
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.system import Setup, System


@dataclass(frozen=True)
class GivenPoorPrior(Condition):
    """Another prior: the setup's `Setup.poor_prior` in place of its x̂₀ and P₀."""

    reference = False
    known_to_estimators = "the other x̂₀ and P₀"

    @property
    def summary(self) -> str:
        return "a prior that is not that of the initial set"

    def setup(self, system: System, setup: Setup) -> Setup:
        if setup.poor_prior is None:
            raise ValueError(
                f"condition 'poor_prior' needs a setup with a poor_prior; "
                f"that of {type(system).__name__} has none"
            )
        return replace(setup, xhat0=setup.poor_prior.xhat0, P0=setup.poor_prior.P0)


@dataclass(frozen=True)
class FarGuess(Condition):
    """An initial estimate further away: each component of x̂₀ is moved by a number of prior standard
    deviations away from the mean of the law of initial states, which is the middle of a box;
    upwards if it is there, but no further than to a bound. P₀ is unchanged."""

    deviations: float = 2.0
    reference = False
    known_to_estimators = "x̂₀"

    @property
    def summary(self) -> str:
        return f"x̂₀ moved by {self.deviations:g} σ of the prior in each state"

    def setup(self, system: System, setup: Setup) -> Setup:
        xhat0, P0 = prior_moments(system, setup)
        away = np.where(xhat0 >= setup.start(system.nx).mean, 1.0, -1.0)
        moved = xhat0 + self.deviations * away * np.sqrt(np.diag(P0))
        if system.state_box is not None:
            moved = system.state_box.clipped(moved)
        return replace(setup, xhat0=tuple(moved.tolist()))


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

    def start_log_density(
        self,
        x0: np.ndarray,
        log_density: Callable[[np.ndarray], np.ndarray],
        inside: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        return np.where(inside(x0), -np.inf, log_density(x0 / self.factor))
