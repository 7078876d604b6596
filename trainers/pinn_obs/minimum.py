"""The interfaces of losses and minimisers, and the best iterate of a training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

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


class Loss(Protocol):
    """What a recipe minimises, as a function of the weights of a network."""

    def terms(self, theta: np.ndarray) -> np.ndarray:
        """Return the terms of the loss (3,) at weights theta (n,): those of the initial estimate,
        of the equation and of the outputs."""
        ...


class Minimiser(Protocol):
    """A minimisation in progress."""

    x: np.ndarray
    """Current weights, shape (n,); each step makes a new array."""
    f: float
    """The loss at x."""

    def step(self, objective: Any) -> bool:
        """Make one iteration on the recipe's loss; return False if it is the last one, since no
        lower loss is found."""
        ...
