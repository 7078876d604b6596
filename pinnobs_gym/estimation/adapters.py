"""The adapter of objects that estimate one episode."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.simulation.record import Prior


class SingleEpisode(Protocol):
    """What `PerEpisode` adapts: an object that estimates one episode."""

    def reset(self, xhat0: np.ndarray, P0: np.ndarray) -> None:
        """Begin an episode from a prior, (nx,) and (nx, nx)."""

    def update(self, t: float, y: np.ndarray, u: np.ndarray) -> np.ndarray:
        """Take the sample y (ny,), u (nu,) at time t (s) and return x̂ (nx,)."""
        ...


@dataclass(frozen=True)
class PerEpisode(Estimator):
    """An adapter for objects that estimate one episode: each row of a batch gets its own.

    Such objects keep their state inside, so a state of this estimator can only be used once.
    """

    make: Callable[[], SingleEpisode] = field(kw_only=True)
    """Makes the object of one row."""
    title: str = field(default="per_episode", kw_only=True)
    """Its name in tables."""

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
