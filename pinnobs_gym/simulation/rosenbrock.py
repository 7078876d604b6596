"""A step of the linearly implicit method for stiff plants.

The method is RODAS of Hairer & Wanner, "Solving Ordinary Differential Equations II", second
edition, 1996, section IV.7 and table 7.3 (the coefficients are those of the authors' program): a
Rosenbrock method of order 4 with six stages and an embedded method of order 3. Both are L-stable.
It solves linear systems alone, with the Jacobian of f at the start of the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.matrices import product
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
_PARTS = np.array([0.0, _PART, 2 * _PART, *_TIMES[1:]])
"""Positions in the step at which f is evaluated."""


def _by_increment() -> np.ndarray:
    """Return the weights (5, 2, 6, 1, 1) of each increment but the last: in the state of each
    stage, and on its right-hand side."""
    weights = np.zeros((5, 2, 6, 1, 1))
    for i, row in enumerate((*_A, (*_A[-1], 1.0))):
        weights[: len(row), 0, i, 0, 0] = row
    for i, row in enumerate(_C):
        weights[: len(row), 1, i, 0, 0] = row
    weights[:, 1] *= _GAMMA
    return weights


_WEIGHTS = _by_increment()


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a batch at their own times, with steps of their own."""

    over: Interval
    t: np.ndarray
    """Time of each row in s, shape (...)."""
    step: np.ndarray
    """Length of the step in s, shape (...); zero for a row that stays."""
    last: np.ndarray | float = np.inf
    """Latest time in s at which f is evaluated, shape (...): the left limit of a time at which f or
    the input jumps, where a step ends at one."""

    def at(self, parts: np.ndarray, axes: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the times t (n, ...) and the inputs (n, ..., nu) at n parts of the steps, to be
        broadcast against states (n, ..., nx) of rows with a number of axes."""
        parts = parts.reshape(-1, *(1,) * axes)
        t = np.minimum(self.t + parts * self.step, self.last)
        u = np.asarray(self.over.input(t))
        return t, _broadcast(u, (*t.shape, u.shape[-1]))


def rosenbrock(rows: Rows, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Take one step of RODAS from x (..., nx).

    Returns:
        The states (..., nx) at the end of the step, and the difference (..., nx) from those by the
        embedded method. Both are NaN in rows whose linear system has no solution.
    """
    system, (*shape, nx) = rows.over.system, x.shape
    first, last = (len(shape), *range(len(shape))), (*range(1, len(shape) + 1), 0)

    def flat(values: np.ndarray) -> np.ndarray:
        """Return (nx, number of rows), which is faster for small matrices, of (..., nx)."""
        return _broadcast(values, x.shape).transpose(first).reshape(nx, -1)

    def rate(stage: slice | int, at: np.ndarray) -> np.ndarray:
        return np.asarray(system.f(t[stage], at, u[stage]))

    t, u = rows.at(_PARTS, len(shape))
    h = _GAMMA * _broadcast(rows.step, tuple(shape))
    matrices = np.eye(nx) - h[..., None, None] * np.asarray(system.f_jacobian(t[0], x, u[0]))
    inverse = _inverse(matrices).reshape(-1, nx, nx).transpose(1, 2, 0)
    h, inverse = h.reshape(-1), np.ascontiguousarray(inverse)
    # ∂f/∂t by one-sided differences of second order, since f may jump at the start of the step.
    rates = rate(slice(3), np.broadcast_to(x, (3, *x.shape)))
    rates = _broadcast(rates, (3, *x.shape))
    now, ahead, further = (flat(each) for each in rates)
    slope = h * (4 * ahead - 3 * now - further) / (2 * _PART)  # times γ and the square of the step
    sums = np.zeros((2, 6, nx, h.size))  # of earlier increments, in states and right-hand sides
    sums[0] += flat(x)
    increment = sums[1, 0]
    for i in range(6):
        if i:
            at = sums[0, i].reshape(nx, *shape).transpose(last)
            now = flat(rate(i + 2, at))
        # (I − γhA)uᵢ = γ(h f + Σ cᵢⱼ uⱼ + γᵢ h² ∂f/∂t): the book's equations times γh, for h = 0.
        right = h * now + sums[1, i]
        if _SLOPES[i]:
            right += _SLOPES[i] * slope
        increment = product(inverse, right[:, None])[:, 0]
        if i < 5:
            sums[:, i + 1 :] += _WEIGHTS[i][:, i + 1 :] * increment
    end, error = sums[0, 5] + increment, increment
    return end.reshape(nx, *shape).transpose(last), error.reshape(nx, *shape).transpose(last)


def _broadcast(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of that shape; NumPy's function takes microseconds where nothing changes."""
    return values if values.shape == shape else np.broadcast_to(values, shape)


def _inverse(matrices: np.ndarray) -> np.ndarray:
    """Return inverses (..., n, n); NaN where there is none."""
    try:
        return np.linalg.inv(matrices)
    except np.linalg.LinAlgError:  # at least one is singular
        usable = np.asarray(np.isfinite(matrices).all(axis=(-2, -1)))
        usable &= np.linalg.det(np.where(usable[..., None, None], matrices, 0.0)) != 0
        result = np.full_like(matrices, np.nan)
        result[usable] = np.linalg.inv(matrices[usable])
        return result
