"""The minimisation of a sum of squares, or of a likelihood, of which the slope is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.projection import multipliers
from pinnobs_gym.simulation.bounds import StateBox

_ROUNDING = 1e-12
"""Largest relative increase of the cost that counts as none."""
_DAMPING = (1e-4, 1e10)
"""The damping at first, and that with which the search is given up."""


@dataclass(frozen=True)
class Quadratic:
    """A cost about a point: ``cost`` − 2·``right``ᵀd + dᵀ·``information``·d after a step d. A
    difference of 1 in the cost is one standard error."""

    cost: float
    """The cost at the point; infinite where the model is not defined."""
    right: np.ndarray
    """Half of the downward slope, shape (n,)."""
    information: np.ndarray
    """Half of the curvature, symmetric and positive semidefinite, shape (n, n)."""


@dataclass(frozen=True)
class Inside:
    """The points v (n,) for which w = offset + Tv is within bounds."""

    offset: np.ndarray
    """Shape (n,)."""
    T: np.ndarray
    """Shape (n, n)."""
    box: StateBox
    """The bounds of w."""

    def nearest(self, v: np.ndarray, information: np.ndarray) -> np.ndarray:
        """Return the point within the bounds at which a quadratic cost with the minimum v, and with
        the curvature ``information`` (n, n), positive definite, is least."""
        w = self.offset + self.T @ v
        if not self.box.outside(w) or not np.isfinite(w).all():
            return v
        C = np.linalg.solve(information, self.T.T)
        force = multipliers(w[None], (self.T @ C)[None], self.box)[0]
        return v - C @ force


def minimised(
    evaluate: Callable[[np.ndarray], Quadratic],
    v: np.ndarray,
    inside: Inside | None = None,
    *,
    most: int,
    least_gain: float,
    longest: float = np.inf,
) -> tuple[np.ndarray, Quadratic]:
    """Return the point of least cost near v (n,), and the cost about it, by the Levenberg-Marquardt
    method (Nocedal & Wright 2006, section 10.3), whose steps are kept within bounds.

    Steps of any length are damped in proportion to the curvature (Marquardt). Where the longest is
    given, components are of comparable size, and are damped alike (Levenberg): far from the minimum
    the curvature of a likelihood says little of how far it is.

    Args:
        evaluate: returns the cost about a point.
        v: where the search begins.
        inside: the points that are allowed; all if None.
        most: largest number of evaluations after the first.
        least_gain: predicted decrease of the cost at which the search ends.
        longest: largest change of a component in one step. It is less after a step that failed.
    """
    best, damping, radius = evaluate(v), _DAMPING[0], longest
    if not np.isfinite(best.cost):
        return v, best
    for _ in range(most):
        diagonal = np.diagonal(best.information)
        size = np.where(diagonal > 0, diagonal, 1.0) if longest == np.inf else np.ones(len(v))
        while True:  # until the step is short enough; one that is not finite never is
            damped = best.information + damping * np.diag(size)
            step = _solved(damped, best.right)
            if abs(step).max() <= radius or damping > _DAMPING[1]:
                break
            damping *= 10
        trial = v + step if inside is None else inside.nearest(v + step, damped)
        gain = float((trial - v) @ best.right)
        at = evaluate(trial)
        if at.cost <= best.cost + _ROUNDING * abs(best.cost):
            v, best, damping, radius = trial, at, damping / 10, min(longest, 2 * radius)
        else:
            damping, radius = damping * 10, float(abs(step).max()) / 4
        if gain <= least_gain or damping > _DAMPING[1]:
            break
    return v, best


def _solved(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return A⁻¹b for A (n, n) positive definite, or nearly so, and scaled in any way."""
    size = np.sqrt(np.diagonal(A))
    return np.linalg.solve(A / np.outer(size, size) + 1e-14 * np.eye(len(b)), b / size) / size
