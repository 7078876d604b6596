"""Adam (Kingma & Ba, "Adam: A Method for Stochastic Optimization", 2015), on the whole record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainers.pinn_obs.quasi_newton import Objective

_MEAN, _SQUARE = 0.9, 0.999
"""β₁ and β₂, the decay rates of the two moving averages."""
_EPSILON = 1e-8


@dataclass(eq=False)
class Adam:
    """A minimisation in progress, in the precision of x."""

    x: np.ndarray
    """Current point, shape (n,)."""
    f: float
    """The function at x."""
    gradient: np.ndarray
    """The gradient at x, shape (n,)."""
    learning_rate: float
    mean: np.ndarray
    """Moving average of the gradients, shape (n,)."""
    square: np.ndarray
    """Moving average of the squared gradients, shape (n,)."""
    steps: int = 0

    @staticmethod
    def start(objective: Objective, x: np.ndarray, learning_rate: float) -> Adam:
        """Begin a minimisation at x (n,)."""
        return Adam(x, *objective(x), learning_rate, np.zeros_like(x), np.zeros_like(x))

    def step(self, objective: Objective) -> bool:
        """Make one iteration; always returns True."""
        self.steps += 1
        mean = _MEAN * self.mean + (1 - _MEAN) * self.gradient
        square = _SQUARE * self.square + (1 - _SQUARE) * self.gradient**2
        rate = self.learning_rate / (1 - _MEAN**self.steps)
        root = np.sqrt(square) / (1 - _SQUARE**self.steps) ** 0.5
        self.x, self.mean, self.square = self.x - rate * mean / (root + _EPSILON), mean, square
        self.f, self.gradient = objective(self.x)
        return True
