"""The nearest point of a box, in the metric of a covariance.

An estimate x̂ with the covariance P that exceeds a bound is moved to the point x of the box with the
least (x − x̂)ᵀP⁻¹(x − x̂), the most probable one of the Gaussian (Simon & Chia 2002; Simon 2010,
"Kalman filtering with state constraints"). Components that are correlated with the one beyond its
bound move with it: where only the sum of two states is known, the sum is kept. Moving each
component to its bound by itself would change the sum. P stays as it is: on which side of the bound
the true state lies does not make it better known.

The same point is the minimum in the box of any quadratic cost with the minimum x̂ and the Hessian
P⁻¹, up to a factor. StateBox-constrained Gauss-Newton steps are therefore found in the same way.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pinnobs_gym.simulation.bounds import StateBox

_ROUNDS = 10
"""Number of steps of the search per bounded component; it rarely takes more than one."""
_DEPENDENT = 1e-12
"""Share of a component's variance that is left, given the components at their bounds, below which
it cannot be moved apart from these."""
_ROUNDING = 1e-10
"""Violation, over the component's standard deviation or the largest violation, that is left to
rounding."""


def nearest(x: np.ndarray, P: np.ndarray, box: StateBox) -> np.ndarray:
    """Return the points of the box that are nearest to x in the metric P⁻¹, shape (batch, n).

    Rows that are not finite stay. A component without variance, or that depends on others at their
    bounds, is moved to its bound by itself.

    Args:
        x: points, shape (batch, n).
        P: covariances, shape (batch, n, n); they may be singular.
        box: the bounds, of shape (n,).
    """
    rows = np.flatnonzero(box.outside(x) & np.isfinite(x).all(axis=-1))
    if not len(rows):
        return x
    x, P = x.copy(), np.ascontiguousarray(P[rows])
    moved = (P @ multipliers(x[rows], P, box)[..., None])[..., 0]
    x[rows] = box.clipped(x[rows] - np.where(np.isfinite(moved), moved, 0.0))
    return x


def nearest_points(points: np.ndarray, P: np.ndarray, box: StateBox) -> np.ndarray:
    """Return points (num_points, batch, n) with those outside of the box moved by `nearest`, in the
    metric of the covariances P (batch, n, n) of their rows."""
    number, row = np.nonzero(box.outside(points))
    if not len(number):
        return points
    points = points.copy(order="K")
    points[number, row] = nearest(points[number, row], P[row], box)
    return points


def kept_inside(holder: Any, box: StateBox) -> Any:
    """Return a `State` or `Estimates` with the estimates outside of the box moved to the `nearest`
    ones in the metric of their covariances; without covariances, to the bounds."""
    xhat = getattr(holder, "xhat", None)  # what is no State is refused later, by its name
    if xhat is None or not box.outside(xhat).any():
        return holder
    if holder.P is None:
        return replace(holder, xhat=np.where(np.isfinite(xhat), box.clipped(xhat), xhat))
    n = xhat.shape[-1]
    moved = nearest(xhat.reshape(-1, n), holder.P.reshape(-1, n, n), box)
    return replace(holder, xhat=moved.reshape(xhat.shape))


def multipliers(x: np.ndarray, P: np.ndarray, box: StateBox) -> np.ndarray:
    """Return the Lagrange multipliers λ (batch, n) of the bounds, positive at an upper bound and
    negative at a lower one, with which x − Pλ is the `nearest` point of the box. The arguments are
    those of `nearest`, all finite."""
    bounded = np.flatnonzero(np.isfinite(box.low) | np.isfinite(box.high))
    # In units of the standard deviations, P is the correlation matrix.
    variance = P[:, bounded, bounded]
    std = np.sqrt(np.where(variance > 0, variance, 1.0))
    C = P[:, bounded[:, None], bounded] / (std[:, :, None] * std[:, None, :])
    low, high = ((side[bounded] - x[:, bounded]) / std for side in (box.low, box.high))
    force = np.zeros(x.shape)
    force[:, bounded] = _dual_active_set(np.ascontiguousarray(C), low, high, variance > 0) / std
    return force


def _dual_active_set(
    C: np.ndarray, low: np.ndarray, high: np.ndarray, movable: np.ndarray
) -> np.ndarray:
    """Return λ (batch, n) for which d = −Cλ is the shortest vector within bounds, in the metric
    C⁻¹.

    The dual method of Goldfarb and Idnani ("A numerically stable dual method for solving strictly
    convex quadratic programs", 1983), for bounds: begin with the minimum without bounds, and bring
    the most violated component to its bound, step by step. Its multiplier grows until the component
    is there or until the multiplier of another one, which gives way, is zero. All rows take their
    steps at once.

    Args:
        C: correlation matrices, shape (batch, n, n).
        low: lower bounds of d, shape (batch, n).
        high: upper bounds of d, shape (batch, n).
        movable: which components have a bound that can be reached, bool (batch, n).
    """
    batch, n = low.shape
    force, movable = np.zeros((batch, n)), movable.copy()
    side = np.zeros((batch, n))  # 1 at an upper bound, −1 at a lower one, 0 inside
    pending = np.full(batch, -1)  # the component on its way to its bound
    tolerance = _ROUNDING * np.maximum(1.0, np.maximum(low, -high).max(axis=1, initial=0.0))
    rows = np.arange(batch)
    for _ in range(_ROUNDS * n):
        d = -(C[rows] @ force[rows, :, None])[..., 0]
        excess = np.maximum(low[rows] - d, d - high[rows])
        open_to = np.where(movable[rows] & (side[rows] == 0), excess, -np.inf)
        p = np.where(pending[rows] < 0, open_to.argmax(axis=1), pending[rows])
        here = np.arange(len(rows))
        unfinished = (pending[rows] >= 0) | (open_to[here, p] > tolerance[rows])
        if not unfinished.any():
            break
        rows, p, d, excess = rows[unfinished], p[unfinished], d[unfinished], excess[unfinished]
        here = np.arange(len(rows))
        sign = np.where(d[here, p] > high[rows, p], 1.0, -1.0)
        response, free = _response(C[rows], side[rows] != 0, p)
        # Length of the step: to the bound, or to the first multiplier that becomes zero.
        whole = np.where(free > _DEPENDENT, excess[here, p] / np.maximum(free, _DEPENDENT), np.inf)
        shrinks = side[rows] * sign[:, None] * response > 0
        size = np.where(shrinks, abs(force[rows]), np.inf) / np.where(shrinks, abs(response), 1.0)
        first = size.argmin(axis=1)
        step = np.minimum(whole, size[here, first])
        impossible = ~np.isfinite(step)
        movable[rows[impossible], p[impossible]] = False
        step = np.where(impossible, 0.0, step) * sign
        force[rows] -= step[:, None] * response
        force[rows, p] += step
        # The component is at its bound, or another one leaves its own first.
        reached = ~impossible & (whole <= size[here, first])
        side[rows[reached], p[reached]] = sign[reached]
        left = ~impossible & ~reached
        side[rows[left], first[left]] = force[rows[left], first[left]] = 0.0
        pending[rows] = np.where(left, p, -1)
    return force


def _response(C: np.ndarray, active: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return by how much the multipliers of the components at their bounds, bool (batch, n), shrink
    per unit of the multiplier of component p (batch,), shape (batch, n), and the variance of p that
    is left given these components, shape (batch,)."""
    here, n = np.arange(len(p)), C.shape[1]
    column = np.where(active, C[here, :, p], 0.0)
    both = active[:, :, None] & active[:, None, :]
    inner = np.where(both, C, np.eye(n))
    response = np.linalg.solve(inner, column[..., None])[..., 0]
    return response, C[here, p, p] - (column * response).sum(axis=1)
