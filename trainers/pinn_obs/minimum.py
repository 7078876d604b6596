"""What a training asks of its minimisation, and what it keeps of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainers.pinn_obs.objective import Objective

FIRST_STEP = 0.3
"""The first step that self-scaled Broyden tries on this loss. The searches' minima lie near a third
of the quasi-Newton step; from there nearly every first trial will do, from 1.0 one of ten does."""


@dataclass(frozen=True, eq=False)
class BestIterate:
    """The weights of the least loss so far."""

    loss: float
    """What is minimised, at these weights."""
    iteration: int
    """The iteration that found it, counted from 1."""
    seed: int
    """What these weights began from."""
    theta: np.ndarray
    """The weights in one vector (n,)."""


@dataclass(frozen=True)
class Mark:
    """The last loss that was lower by enough for the patience to begin anew."""

    loss: float
    iteration: int


class Minimiser(Protocol):
    """A minimisation in progress."""

    x: np.ndarray
    """Where it stands, shape (n,); made anew by each step."""
    f: float
    """The loss there."""

    def step(self, objective: Objective) -> bool:
        """One iteration; False if no lower value can be found."""
        ...
