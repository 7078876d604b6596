"""The libraries of compiled algorithms of a plant."""

from __future__ import annotations

import ctypes
import os
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.kernels.build import library
from pinnobs_gym.simulation.kernels.calls import Plan, address
from pinnobs_gym.simulation.kernels.plant_code import plant_code
from pinnobs_gym.simulation.kernels.source import library_source
from pinnobs_gym.simulation.system import System, initial_states, is_number, vector

LARGEST = 12
"""Largest number of states of a plant that is compiled; beyond it BLAS takes less time."""
_POINTS = 32
"""Number of states at which the functions of a library are compared with the plant's own."""


@dataclass(frozen=True, eq=False)
class PlantLibrary:
    """Compiled algorithms for the equations of a plant."""

    code: ctypes.CDLL
    numbers: tuple[str, ...]
    """The attributes of the system that the code takes as numbers, in their order."""


def plant_library(system: System, template: str) -> PlantLibrary | str:
    """Return the library of an algorithm for a plant, or the reason in one line why there is none.

    Systems of one class that differ in numbers only share it.

    Args:
        system: the plant.
        template: the algorithm, such as ``ekf``.
    """
    if os.environ.get("PINNOBS_KERNELS") == "0":
        return "kernels are turned off by PINNOBS_KERNELS=0"
    return _library(_usual(system), template)


def _usual(system: System) -> System:
    """Return the plant with the numbers of its class, which stand for all."""
    numbers = {n: v for n, v in type(system)().parameters.items() if is_number(v)}
    return replace(system, measured_input=False, **numbers)


@cached_by_plant
def _library(system: System, template: str) -> PlantLibrary | str:
    reason = _not_compiled(system)
    if reason:
        return reason
    try:
        plant = plant_code(system)
    except Exception as error:  # whatever the user's functions raise when they are given symbols
        return f"cannot be traced: {type(error).__name__}: {' '.join(str(error).split())}"
    code = library(library_source(plant, template))
    made = PlantLibrary(code, plant.numbers)
    return made if _agrees(system, made) else "its compiled equations give other values"


def _not_compiled(system: System) -> str:
    """Return why a plant is not compiled, an empty text if nothing prevents it."""
    cls = type(system)
    if system.own_flow:
        return "it moves by a flow of its own"
    if system.stiff:
        return "it is stiff"
    if system.nx > LARGEST:
        return f"it has {system.nx} states, more than {LARGEST}"
    for name in ("output_residual", "state_residual"):
        if getattr(cls, name) is not getattr(System, name):
            return f"it defines {name}"
    return ""


def _agrees(system: System, made: PlantLibrary) -> bool:
    """Return whether the compiled functions give the plant's own values, at states of the initial
    set and within twice the scale of these."""
    setup, scale = system.setups["benchmark"], vector(system.scale, system.nx, "scale")
    rng = np.random.default_rng(0)
    x = initial_states(system, setup, _POINTS)
    x[::2] += scale * rng.uniform(-2, 2, (len(x[::2]), system.nx))
    t = rng.uniform(0, setup.duration, _POINTS)
    t = np.floor(t) if system.discrete else t
    with np.errstate(all="ignore"):
        u = np.asarray(system.input(t))
        own = [
            *(system.f(t, x, u), system.f_jacobian(t, x, u)),
            *(system.h(t, x, u), system.h_jacobian(t, x, u), u),
        ]
        found = evaluated(system, made, t, x, u)
        for value, slopes, mine in (
            (own[0], own[1], found[0]),
            (own[2], own[3], found[2]),
        ):
            # Rounding errors are relative to the terms of a value.
            terms = (abs(slopes) * np.maximum(abs(x), scale)[:, None]).sum(axis=-1)
            if not _same(value, mine, 1e-9 * (abs(value) + terms)):
                return False
        # Jacobians that a system writes itself may be approximate in their last digits.
        return all(
            _same(a, b, 1e-6 * (1e-3 * abs(a).max(initial=0.0) + abs(a)))
            for a, b in ((own[1], found[1]), (own[3], found[3]), (own[4], found[4]))
        )


def _same(a: np.ndarray, b: np.ndarray, allowed: np.ndarray) -> bool:
    """Return whether the differences are at most those allowed, where the first are finite."""
    return bool(((abs(a - b) <= allowed) | ~np.isfinite(a) | ~np.isfinite(allowed)).all())


def evaluated(
    system: System, made: PlantLibrary, t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> list[np.ndarray]:
    """Return the compiled f (n, nx), its Jacobian, h (n, ny), its Jacobian, and the input (n, nu)
    at n times (s), states (n, nx) and inputs (n, nu)."""
    nx, ny, nu, n = system.nx, system.ny, system.nu, len(t)
    plan = Plan.of(system, made.numbers, np.zeros((nx, 0)), np.zeros((1, ny, ny, 1)))
    shapes = [(nx,), (nx, nx), (ny,), (ny, nx), (nu,)]
    results = [np.empty((*shape, n)) for shape in shapes]
    given = [np.ascontiguousarray(part.T, dtype=float) for part in (t, x, u)]
    evaluate = made.code.evaluate
    evaluate.restype = None
    evaluate.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 8]
    evaluate(ctypes.addressof(plan.structure), n, *map(address, [*given, *results]))
    return [np.moveaxis(result, -1, 0) for result in results]
