"""A step of the linearly implicit method for stiff plants.

The method is RODAS of Hairer & Wanner, "Solving Ordinary Differential Equations II", second
edition, 1996, section IV.7 and table 7.3 (the coefficients are those of the authors' program): a
Rosenbrock method of order 4 with six stages and an embedded method of order 3. Both are L-stable.
It solves linear systems alone, with the Jacobian of f at the start of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.motion import Interval

_GAMMA = 0.25
"""The method's diagonal coefficient γ."""
_TIMES = (0.0, 0.386, 0.21, 0.63, 1.0, 1.0)
"""Position of each stage in the step."""
_SLOPES = (0.25, -0.1043, 0.1035, -0.3620000000000023e-01, 0.0, 0.0)
"""Weight of ∂f/∂t in each stage, over the step."""
_A = (
    (),
    (1.544,),
    (0.9466785280815826, 0.2557011698983284),
    (3.314825187068521, 2.896124015972201, 0.9986419139977817),
    (1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950),
)
"""Weights of the earlier increments in the state of each stage; those of the last stage are those
of the fifth, and 1."""
_C = (
    (),
    (-5.6688,),
    (-2.430093356833875, -0.2063599157091915),
    (-0.1073529058151375, -9.594562251023355, -20.47028614809616),
    (7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160),
    (
        8.083246795921522,
        -7.981132988064893,
        -31.52159432874371,
        16.31930543123136,
        -6.058818238834054,
    ),
)
"""Weights of the earlier increments over the step on the right-hand side of each stage."""
_PART = 1e-5
"""Part of the step by which time is shifted in the differences for ∂f/∂t."""


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a batch at their own times, with steps of their own."""

    over: Interval
    t: np.ndarray
    """Time of each row in s, shape (...)."""
    step: np.ndarray
    """Length of the step in s, shape (...); zero for a row that stays."""

    def rate(self, part: float, x: np.ndarray) -> np.ndarray:
        """Return f (..., nx) at states x (..., nx), a part of the step after its start."""
        t = self.t + part * self.step
        return np.asarray(self.over.system.f(t, x, self.over.input(t)))

    def jacobian(self, part: float, x: np.ndarray) -> np.ndarray:
        """Return ∂f/∂x, (..., nx, nx), at such states."""
        t = self.t + part * self.step
        return np.asarray(self.over.system.f_jacobian(t, x, self.over.input(t)))


def rosenbrock(rows: Rows, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take one step of RODAS from x (..., nx).

    Returns:
        The states (..., nx) at the end of the step, and the difference (..., nx) from those by the
        embedded method. Both are NaN in rows whose linear system has no solution.
    """
    h = rows.step[..., None]
    rate = rows.rate(0.0, x)
    inverse = _inverse(np.eye(x.shape[-1]) - _GAMMA * h[..., None] * rows.jacobian(0.0, x))
    # ∂f/∂t by one-sided differences of second order, since f may jump at the start of the step.
    ahead, further = (rows.rate(n * _PART, x) for n in (1, 2))
    slope = (4 * ahead - 3 * rate - further) / (2 * _PART)  # times the step
    increments: list[np.ndarray] = []
    point = x
    for i in range(6):
        if i == 5:
            point = point + increments[-1]
        elif i:
            point = x + _sum(_A[i], increments)
        if i:
            rate = rows.rate(_TIMES[i], point)
        # (I − γhA)uᵢ = γ(h f + Σ cᵢⱼ uⱼ + γᵢ h² ∂f/∂t): the book's equations times γh, for h = 0.
        right = h * (rate + _SLOPES[i] * slope)
        right = _GAMMA * (right + _sum(_C[i], increments) if i else right)
        columns = (inverse[..., j] * right[..., j, None] for j in range(x.shape[-1]))
        increments.append(sum(columns, np.zeros(())))  # in one order, in any batch
    return point + increments[-1], increments[-1]


def _sum(weights: tuple[float, ...], parts: list[np.ndarray]) -> np.ndarray:
    """Return the weighted sum of arrays, in their order."""
    total = weights[0] * parts[0]
    for weight, part in zip(weights[1:], parts[1:], strict=True):
        total = total + weight * part
    return total


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Return inverses (..., n, n); NaN where there is none."""
    usable = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
    usable &= np.linalg.det(np.where(usable[..., None, None], matrices, 0.0)) != 0
    result = np.full_like(matrices, np.nan)
    result[usable] = np.linalg.inv(matrices[usable])
    return result
