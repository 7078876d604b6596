"""An EKF of one episode by functions of CasADi that process one sample."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import casadi
import numpy as np
from kernel_figures.steps import flow, matrices

from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.traced_code import Trace

COMPILED = {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O3 -march=native"]}}
"""Options of functions whose C code CasADi has compiled."""


class Components:
    """The components of a vector, by the last index as in NumPy."""

    def __init__(self, vector: Any) -> None:
        self.vector = vector

    def __getitem__(self, place: tuple[Any, int]) -> Any:
        return self.vector[place[-1]]


def function(system: System, name: str) -> Callable[..., Any]:
    """Return f, h or the input of a system as a function of t, x and u in CasADi, whose functions
    have the names of NumPy's."""
    trace = Trace(plant_form(system), name)
    if not trace.values:
        return lambda t, x, u: casadi.SX(0, 1)
    names: dict[str, Any] = {"np": casadi, "stack": lambda x, *parts: casadi.vertcat(*parts)}
    exec(compile(trace.source([trace.values], "vector"), "<casadi>", "exec"), names)
    return lambda t, x, u: names["function"](system, t, Components(x), Components(u))


def filter_functions(ekf: EKF, dt: float, **options: Any) -> tuple[Any, Any]:
    """Return the functions (x, P, t, y) of the first sample and (x, P, before, t, y) of later ones,
    whose results are x and P.

    Args:
        ekf: the filter.
        dt: the time between samples in s.
        options: options of CasADi's functions.
    """
    system, (Q, R) = ekf.system, matrices(ekf, dt)
    f, h, given = (function(system, name) for name in ("f", "h", "input"))
    moved = flow(system, dt, f, given)
    x, P = casadi.SX.sym("x", system.nx), casadi.SX.sym("P", system.nx, system.nx)
    sizes = {"before": 1, "t": 1, "y": system.ny}
    before, t, y = (casadi.SX.sym(name, size) for name, size in sizes.items())

    def corrected(x: Any, P: Any) -> list[Any]:
        at = casadi.SX.sym("x", system.nx)
        output = h(t, at, given(t, at, None))
        H, e = casadi.substitute([casadi.jacobian(output, at), y - output], [at], [x])
        S = H @ P @ H.T + R
        K = casadi.solve(S, H @ P).T
        M = casadi.SX.eye(system.nx) - K @ H
        return [x + K @ e, M @ P @ M.T + K @ R @ K.T]

    ahead = moved(x, before, t - before)
    F = casadi.jacobian(ahead, x)
    first = casadi.Function("first", [x, P, t, y], corrected(x, P), options)
    predicted = corrected(ahead, F @ P @ F.T + Q)
    return first, casadi.Function("later", [x, P, before, t, y], predicted, options)


def casadi_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return a call whose result is the estimates (num_samples, nx) of the record's first episode,
    by functions that are called with arrays of NumPy and run in CasADi's virtual machine."""
    first, later = filter_functions(ekf, float(record.t[1] - record.t[0]))
    samples = list(zip(record.t.tolist(), record.y[0], strict=True))
    mean, cov = record.prior.mean[0], record.prior.cov[0]

    def play() -> np.ndarray:
        xhat, x, P, before = [], mean, cov, None
        for t, y in samples:
            x, P = first(x, P, t, y) if before is None else later(x, P, before, t, y)
            before = t
            xhat.append(x.full()[:, 0])
        return np.array(xhat)

    return play


def compiled_ekf(ekf: EKF, record: Record) -> Callable[[], np.ndarray]:
    """Return the same call by functions in compiled C, whose arguments and results are buffers:
    the fastest call of CasADi from Python."""
    first, later = filter_functions(ekf, float(record.t[1] - record.t[0]), **COMPILED)
    nx, n = ekf.system.nx, record.num_samples
    ends = [(np.empty(nx), np.empty((nx, nx))) for _ in range(2)]
    times, y = np.empty((2, 1)), np.empty(ekf.system.ny)
    samples = list(zip(record.t.tolist(), record.y[0], strict=True))

    def bound(function: Any, arguments: list[np.ndarray], results: tuple[np.ndarray, ...]) -> Any:
        buffer, call = function.buffer()
        for i, array in enumerate(arguments):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(results):
            buffer.set_res(i, array.data)
        return call, buffer  # the buffer has to live as long as the call

    # Each call reads what the one before wrote; P is symmetric, so that its order does not count.
    begin = bound(first, [*ends[1], times[1], y], ends[0])
    steps = [bound(later, [*ends[1 - k], *times, y], ends[k]) for k in range(2)]

    def play() -> np.ndarray:
        xhat = np.empty((n, nx))
        ends[1][0][:], ends[1][1][:] = record.prior.mean[0], record.prior.cov[0]
        for k, (t, measured) in enumerate(samples):
            times[1, 0], y[:] = t, measured
            (steps[k % 2] if k else begin)[0]()
            times[0, 0] = t
            xhat[k] = ends[k % 2][0]
        return xhat

    return play
