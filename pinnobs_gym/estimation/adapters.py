"""An adapter for objects that estimate a single episode."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.simulation.record import Prior


class SingleEpisode(Protocol):
    """Protocol of an object that estimates one episode, for `PerEpisode`."""

    def reset(self, xhat0: np.ndarray, P0: np.ndarray) -> None:
        """Begin an episode from the prior's mean (nx,) and covariance (nx, nx)."""

    def update(self, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Process the sample y (ny,), u (nu,) at time t (s), and return x̂ (nx,)."""
        ...


@dataclass(frozen=True)
class PerEpisode(Estimator):
    """Adapter for objects that estimate one episode; each row of a batch has its own object.

    The objects are mutable, so each state of this estimator can be updated only once.
    """

    make: Callable[[], SingleEpisode] = field(kw_only=True)
    """Creates the object of one row."""
    title: str = field(default="per_episode", kw_only=True)
    """Name in tables."""

    exempt_from = {
        "model_alone": "what it adapts may know neither the model nor the prior",
        "units": "what it adapts may have settings in one unit",
    }

    @property
    def label(self) -> str:
        return self.title

    def reset(self, prior: Prior) -> State:
        rows = [self.make() for _ in prior.mean]
        for row, mean, cov in zip(rows, prior.mean, prior.cov, strict=True):
            row.reset(mean.copy(), cov.copy())
        return State(prior.mean.copy(), memory=rows)

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        rows = copy.copy(state.memory)
        xhat = [row.update(t, y_row, u_row) for row, y_row, u_row in zip(rows, y, u, strict=True)]
        return State(np.array(xhat, dtype=float), t=t, u=u, memory=rows)
