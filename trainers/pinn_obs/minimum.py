"""The interface of minimisers, and the best iterate of a training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainers.pinn_obs.objective import Objective

FIRST_STEP = 0.3
"""First trial step of the line searches of self-scaled Broyden on this loss. Their minima lie near
a third of the quasi-Newton step: nearly all first trials are accepted, but one in ten with 1.0."""


@dataclass(frozen=True, eq=False)
class BestIterate:
    """The weights with the least loss so far."""

    loss: float
    """The minimised loss at these weights."""
    iteration: int
    """The iteration of these weights, counted from 1."""
    seed: int
    """Seed of the initial weights."""
    theta: np.ndarray
    """The weights in one vector (n,)."""


@dataclass(frozen=True)
class Mark:
    """The last loss that was low enough to reset the patience."""

    loss: float
    iteration: int


class Minimiser(Protocol):
    """A minimisation in progress."""

    x: np.ndarray
    """Current weights, shape (n,); each step makes a new array."""
    f: float
    """The loss at x."""

    def step(self, objective: Objective) -> bool:
        """Make one iteration; return False if no lower loss is found."""
        ...
