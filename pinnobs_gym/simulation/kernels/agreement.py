"""The comparison of compiled functions with a plant's own, without which none is used."""

from __future__ import annotations

import ctypes
from dataclasses import fields, replace

import numpy as np

from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.kernels.calls import Plan, address
from pinnobs_gym.simulation.system import System, initial_states, vector

_POINTS = 32
"""Number of states at which the functions are compared."""


def agrees(system: System, code: ctypes.CDLL, numbers: tuple[str, ...]) -> bool:
    """Return whether the compiled functions give the values of this very system, with its own
    numbers, at states of the initial set and within twice the scale of these.

    A Jacobian that the system does not write is compared with differences.

    Args:
        system: the system.
        code: the library.
        numbers: the attributes of the system that the code takes, in their order.
    """
    setup, scale = system.setups["benchmark"], vector(system.scale, system.nx, "scale")
    rng = np.random.default_rng(0)
    x = initial_states(_rows(system, numbers, np.zeros(1, dtype=int)), setup, _POINTS)
    system = _rows(system, numbers, np.arange(_POINTS))
    x[::2] += scale * rng.uniform(-2, 2, (len(x[::2]), system.nx))
    t = rng.uniform(0, setup.duration, _POINTS)
    t = np.floor(t) if system.discrete else t
    with np.errstate(all="ignore"):
        u = np.asarray(system.input(t))
        f, A, h, H, inputs = evaluated(system, code, numbers, t, x, u)
        size = np.maximum(abs(x), scale)
        for name, found, slopes in (("f", f, A), ("h", h, H)):
            value = np.asarray(getattr(system, name)(t, x, u))
            own = _slopes(system, name, t, x, u, scale)
            if not np.isfinite(value).any():
                return False  # nothing could be compared
            # Rounding errors are relative to the terms of a value.
            terms = abs(value) + (abs(own) * size[:, None]).sum(axis=-1)
            if not _same(value, found, 1e-9 * terms):
                return False
            # Jacobians may be approximate in their last digits, as those by differences are.
            allowed = 1e-6 * (1e-3 * abs(own).max(initial=0.0) + abs(own))
            if getattr(type(system), f"{name}_jacobian") is getattr(System, f"{name}_jacobian"):
                allowed = allowed + 1e-7 * terms[..., None] / size[:, None]
            if not _same(own, slopes, allowed):
                return False
        return _same(u, inputs, 1e-9 * (1e-3 * abs(u).max(initial=0.0) + abs(u)))


def _rows(system: System, numbers: tuple[str, ...], rows: np.ndarray) -> System:
    """Return the system with the numbers of these rows, where it has one per row."""
    values = {f.name: getattr(system, f.name) for f in fields(system) if f.name in numbers}
    changed = {n: value[rows % len(value)] for n, value in values.items() if np.ndim(value)}
    return replace(system, **changed) if changed else system


def _slopes(
    system: System, name: str, t: np.ndarray, x: np.ndarray, u: np.ndarray, scale: np.ndarray
) -> np.ndarray:
    """Return the system's own Jacobian of f or h, or differences if it writes none."""
    if getattr(type(system), f"{name}_jacobian") is not getattr(System, f"{name}_jacobian"):
        return np.asarray(getattr(system, f"{name}_jacobian")(t, x, u))
    periods = system.output_period if name == "h" else None
    return central_differences(lambda x: getattr(system, name)(t, x, u), x, scale, periods=periods)


def _same(a: np.ndarray, b: np.ndarray, allowed: np.ndarray) -> bool:
    """Return whether the differences are at most those allowed, where the first are finite."""
    return bool(((abs(a - b) <= allowed) | ~np.isfinite(a) | ~np.isfinite(allowed)).all())


def evaluated(
    system: System,
    code: ctypes.CDLL,
    numbers: tuple[str, ...],
    t: np.ndarray,
    x: np.ndarray,
    u: np.ndarray,
) -> list[np.ndarray]:
    """Return the compiled f (n, nx), its Jacobian, h (n, ny), its Jacobian, and the input (n, nu)
    at n times (s), states (n, nx) and inputs (n, nu)."""
    nx, ny, nu, n = system.nx, system.ny, system.nu, len(t)
    plan = Plan.of(system, numbers, np.zeros((nx, 0)), np.zeros((1, ny, ny, 1)))
    shapes = [(nx,), (nx, nx), (ny,), (ny, nx), (nu,)]
    results = [np.empty((*shape, n)) for shape in shapes]
    given = [np.ascontiguousarray(part.T, dtype=float) for part in (t, x, u)]
    evaluate = code.evaluate
    evaluate.restype = None
    evaluate.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 8]
    evaluate(ctypes.addressof(plan.structure), n, *map(address, [*given, *results]))
    return [np.moveaxis(result, -1, 0) for result in results]
