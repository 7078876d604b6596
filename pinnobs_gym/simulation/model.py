"""The discrete-time step of the model, shared by model-based estimators, and its Jacobian."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.matrices import identity, product
from pinnobs_gym.simulation.runge_kutta import longest_step, runge_kutta
from pinnobs_gym.simulation.system import Array, System

_STAGES = np.array([0, 1, 1, 2])
"""Index into (start, middle, end) of the step for each of the four Runge-Kutta stages."""

_PARTS = np.array([0.0, 0.5, 1.0])
"""A step's start, middle and end, in steps."""


def model_step(
    system: System, t0: Array, t1: Array, x: Array, u0: Array | None = None, u1: Array | None = None
) -> Array:
    """Propagate the model's state x (..., nx) from t0 to t1 (s) by the classical Runge-Kutta
    method, in equal steps of at most `longest_step`. Rows (batch, nx) of x may
    have their own times, t0 and t1 of shape (batch,); all rows take the same number of steps.

    ``u0`` and ``u1`` (..., nu) are the inputs sampled at t0 and t1. They are used, with linear
    interpolation between them, only if the system's input is measured.
    """
    for t, step, u in substeps(system, t0, t1, x, u0, u1):
        x = runge_kutta(partial(_rate, system, t, u), x, step)
    return x


def _rate(system: System, t: Array, u: Array, stage: int, x: Array) -> Array:
    """Return f at a stage of a step with times t (3, ...) and inputs u (3, ..., nu)."""
    k = _STAGES[stage]
    return system.f(t[k], x, u[k])


def model_step_jacobian(
    system: System,
    t0: float | np.ndarray,
    t1: float | np.ndarray,
    x: np.ndarray,
    u0: np.ndarray | None = None,
    u1: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return `model_step` of x (batch, nx), and its exact Jacobian ∂x(t1)/∂x(t0), shape (batch, nx,
    nx), with the batch innermost in memory."""
    F = None
    batch, nx = x.shape
    x = np.ascontiguousarray(x.T)  # the batch is last here; the system gets transposed views
    start = identity(nx, batch)
    points = np.empty((4, nx, batch))
    shown = points.transpose(0, 2, 1)
    for t, step, u in substeps(system, t0, t1, x.T, u0, u1):
        by_row = t.ndim == 2
        h = step[:, 0] if by_row else step
        times, inputs = t[_STAGES], u[_STAGES]

        def rate(
            stage: int, at: np.ndarray, times: np.ndarray = times, inputs: np.ndarray = inputs
        ) -> np.ndarray:
            points[stage] = at
            return system.f(times[stage], shown[stage], inputs[stage]).T

        x = runge_kutta(rate, x, h)
        # Jacobians A of f at the four stages.
        A = system.f_jacobian(
            times if by_row else times[:, None],
            shown,
            inputs[:, None] if u.ndim == 2 else inputs,
        )
        A = np.ascontiguousarray(A.transpose(0, 2, 3, 1))  # (4, nx, nx, batch)
        # Integrate the variational equation Φ' = A(t)Φ by the same method at the same stages.
        flow = runge_kutta(partial(_variation, A), start, h)
        # Chain rule over the substeps.
        F = flow if F is None else product(flow, F)
    assert F is not None  # there is at least one substep
    return x.T, F.transpose(2, 0, 1)


def _variation(A: np.ndarray, stage: int, flow: np.ndarray) -> np.ndarray:
    """Return Φ' = AΦ, (nx, nx, batch), given the flow Φ since the start of the step and A (4, nx,
    nx, batch)."""
    return A[stage] if stage == 0 else product(A[stage], flow)  # Φ = I at the start


def substeps(
    system: System,
    t0: Array,
    t1: Array,
    x: Array,
    u0: Array | None,
    u1: Array | None,
    longest: float = np.inf,
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield the Runge-Kutta steps of `model_step` from t0 to t1, none longer than ``longest`` (s).

    Each item holds the three times (s) at which f is evaluated, the length of the step, and the
    inputs at these times, (3, ..., nu). The times are (3,) or, where t0 and t1 are arrays (batch,),
    (3, batch), and the length is (batch, 1).
    """
    xp = np if isinstance(x, np.ndarray) else array_namespace(x)
    longest = min(longest, longest_step(system))
    by_row = getattr(t0, "ndim", 0) > 0
    whole = t1 - t0
    count = max(1, math.ceil(float(whole.max() if by_row else whole) / longest - 1e-6))
    # All rows take the number of steps that the longest interval needs.
    step = whole[:, None] / count if by_row else float(whole) / count
    parts = _PARTS if xp is np else xp.asarray(_PARTS, dtype=x.dtype)
    for k in range(count):
        part = parts + k if k else parts
        after = part * step
        t = t0 + (after.T if by_row else after)
        if system.measured_input:
            if u0 is None or u1 is None:
                raise ValueError(f"{type(system).__name__} has a measured input; u is missing")
            # Interpolate measured inputs linearly.
            weight = (part / count).reshape(3, *([1] * u0.ndim))
            u = (1 - weight) * u0 + weight * u1
        else:
            u = system.input(t)
        yield t, step, u
