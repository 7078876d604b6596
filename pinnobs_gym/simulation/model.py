"""The discrete step of the model that model-based estimators share, and its Jacobian."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.matrices import identity, product
from pinnobs_gym.simulation.system import Array, System

_STAGES = np.array([0, 1, 1, 2])
"""Which of a step's start, middle and end each of the four Runge-Kutta stages looks at."""


def model_step(
    system: System, t0: Array, t1: Array, x: Array, u0: Array | None = None, u1: Array | None = None
) -> Array:
    """The state (..., nx) at t1 of the model that is in x at t0 (s), by the classical Runge-Kutta
    method in equal steps of at most the system's `System.model_step`. Rows (batch, nx) of x may
    each have times of their own, t0 and t1 then being (batch,); all take as many steps.

    ``u0`` and ``u1`` (..., nu) are the inputs sampled at t0 and t1; they are used, joined by a
    straight line, only if the system's input is a measured one.
    """
    for t, step, u in substeps(system, t0, t1, x, u0, u1):
        k1 = system.f(t[0], x, u[0])
        k2 = system.f(t[1], x + step / 2 * k1, u[1])
        k3 = system.f(t[1], x + step / 2 * k2, u[1])
        k4 = system.f(t[2], x + step * k3, u[2])
        x = x + step / 6 * (k1 + 2 * (k2 + k3) + k4)
    return x


def model_step_jacobian(
    system: System,
    t0: float | np.ndarray,
    t1: float | np.ndarray,
    x: np.ndarray,
    u0: np.ndarray | None = None,
    u1: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """What `model_step` returns for x (batch, nx), and its exact Jacobian ∂x(t1)/∂x(t0), shape
    (batch, nx, nx), with the batch innermost in memory."""
    F = None
    batch, nx = x.shape
    x = np.ascontiguousarray(x.T)  # the batch comes last here; the system is shown transposed views
    for t, step, u in substeps(system, t0, t1, x.T, u0, u1):
        by_row = t.ndim == 2
        h = step[:, 0] if by_row else step
        points = np.empty((4, nx, batch))
        at = points.transpose(0, 2, 1)
        points[0] = x
        k1 = system.f(t[0], at[0], u[0]).T
        np.add(x, h / 2 * k1, out=points[1])
        k2 = system.f(t[1], at[1], u[1]).T
        np.add(x, h / 2 * k2, out=points[2])
        k3 = system.f(t[1], at[2], u[1]).T
        np.add(x, h * k3, out=points[3])
        k4 = system.f(t[2], at[3], u[2]).T
        x = x + _increment(h, k1, k2, k3, k4)
        # The variational equation Φ' = A(t)Φ, by the same method along the same stages.
        times, inputs = t[_STAGES], u[_STAGES]
        A = system.f_jacobian(
            times if by_row else times[:, None], at, inputs[:, None] if u.ndim == 2 else inputs
        )
        A = np.ascontiguousarray(A.transpose(0, 2, 3, 1))  # (4, nx, nx, batch)
        K2 = _slope(A[1], h / 2, A[0])
        K3 = _slope(A[2], h / 2, K2)
        K4 = _slope(A[3], h, K3)
        flow = _increment(h, A[0], K2, K3, K4)
        flow += identity(nx, batch)
        F = flow if F is None else product(flow, F)
    assert F is not None  # there is at least one substep
    return x.T, F.transpose(2, 0, 1)


def _increment(
    h: float | np.ndarray, k1: np.ndarray, k2: np.ndarray, k3: np.ndarray, k4: np.ndarray
) -> np.ndarray:
    """h(k1 + 2k2 + 2k3 + k4)/6, of arrays with the batch last."""
    total = k2 + k3
    total *= 2
    total += k1
    total += k4
    total *= h / 6
    return total


def _slope(A: np.ndarray, h: float | np.ndarray, K: np.ndarray) -> np.ndarray:
    """A(I + hK), the rate at which a flow changes after the time h at the rate K; matrices
    (nx, nx, batch)."""
    rate = product(A, K)
    rate *= h
    rate += A
    return rate


def substeps(
    system: System,
    t0: Array,
    t1: Array,
    x: Array,
    u0: Array | None,
    u1: Array | None,
    longest: float = np.inf,
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield, for each Runge-Kutta step of `model_step` from t0 to t1, the three times (s) at which
    f is evaluated, the step, and the inputs at these times, (3, ..., nu). No step is over
    ``longest`` (s).

    The times are (3,) or, where t0 and t1 are arrays (batch,), (3, batch), and the step (batch, 1).
    """
    xp = np if isinstance(x, np.ndarray) else array_namespace(x)
    longest = min(longest, system.model_step or system.setups["benchmark"].dt)
    by_row = getattr(t0, "ndim", 0) > 0
    whole = t1 - t0
    count = max(1, math.ceil(float(whole.max() if by_row else whole) / longest - 1e-6))
    step = whole[:, None] / count if by_row else float(whole) / count
    for k in range(count):
        part = xp.asarray([k, k + 0.5, k + 1], dtype=x.dtype)
        after = part * step
        t = t0 + (after.T if by_row else after)
        if system.measured_input:
            if u0 is None or u1 is None:
                raise ValueError(f"{type(system).__name__} has a measured input; u is missing")
            weight = (part / count).reshape(3, *([1] * u0.ndim))
            u = (1 - weight) * u0 + weight * u1
        else:
            u = system.input(t)
        yield t, step, u
