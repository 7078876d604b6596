"""The arguments of compiled code, as arrays in the layout that it expects.

The batch is the last axis of all arrays, and their entries are contiguous doubles.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System

_POINTER, _INT, _DOUBLE = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double


class PlanStructure(ctypes.Structure):
    """``struct plan`` of ``common.h``."""

    _fields_ = [
        *(("p", _POINTER), ("p_rows", _INT), ("L", _POINTER), ("m", _INT)),
        *(("D", _POINTER), ("diagonal", _INT)),
        *(("R", _POINTER), ("R_samples", _INT), ("R_rows", _INT)),
        *(("longest", _DOUBLE), ("breaks", _POINTER), ("num_breaks", _INT)),
        *(("input", _INT), ("discrete", _INT)),
        *(("state_period", _POINTER), ("output_period", _POINTER)),
        *(("low", _POINTER), ("high", _POINTER)),
        *(("gate", _POINTER), ("patience", _INT), ("huber", _DOUBLE)),
        *(("growth", _POINTER), ("caution", _DOUBLE)),
        *(("network", _POINTER), ("width", _INT), ("scale", _POINTER)),
        *(("theta", _DOUBLE), ("per_scale", _POINTER)),
        *(("switching", _DOUBLE), ("layer", _DOUBLE), ("carried", _INT)),
        *((name, _POINTER) for name in ("points", "weights", "roots")),
        *(("num_points", _INT), ("outlier_rate", _DOUBLE), ("outlier_size", _DOUBLE)),
    ]


class CallStructure(ctypes.Structure):
    """``struct call`` of ``filter.h``."""

    _fields_ = [
        *(("plan", _POINTER), ("batch", _INT), ("samples", _INT)),
        *((name, _POINTER) for name in ("t", "y", "u", "x", "P", "innovation", "S")),
        *((name, _POINTER) for name in ("t_before", "u_before", "x_before", "P_before")),
        *((name, _POINTER) for name in ("carried", "gain", "x_predicted", "P_predicted", "F", "Q")),
    ]


def address(array: Any) -> int:
    """Return the address of an array's first entry, faster than NumPy if it is contiguous."""
    try:
        return ctypes.addressof(ctypes.c_double.from_buffer(array))
    except (TypeError, ValueError, BufferError):
        return array.ctypes.data


def plant_numbers(system: System, numbers: Sequence[str]) -> np.ndarray:
    """Return attributes of a system that its code takes as numbers, (n,), or (n, batch) if any has
    one per row. Arrays of a single number hold for any number of rows."""
    values = [np.asarray(getattr(system, name), dtype=float) for name in numbers]
    values = [value.reshape(()) if value.shape == (1,) else value for value in values]
    by_row = any(value.ndim for value in values)
    return np.array(np.broadcast_arrays(*values) if by_row else values, dtype=float)


@dataclass(eq=False)
class Plan:
    """What stays the same over the samples of a call, with the arrays that it points to."""

    structure: PlanStructure
    kept: list[np.ndarray]

    @staticmethod
    def of(system: System, numbers: Sequence[str], L: np.ndarray, R: np.ndarray) -> Plan:
        """Return the plan of a model.

        Args:
            system: the model.
            numbers: the attributes of the system that its code takes.
            L: process noise, shape (nx, m).
            R: output noise, shape (samples or 1, ny, ny, batch or 1).
        """
        plan = Plan(PlanStructure(), [])
        plan.set(**plan_values(system, numbers, L))
        return plan.with_R(R)

    def with_R(self, R: np.ndarray) -> Plan:
        """Return the plan with another output noise R (samples or 1, ny, ny, batch or 1)."""
        plan = Plan(PlanStructure.from_buffer_copy(self.structure), [*self.kept])
        plan.set(R=R, R_samples=int(len(R) > 1), R_rows=int(R.shape[-1] > 1))
        return plan

    def set(self, **values: np.ndarray | float | None) -> None:
        """Set fields: arrays by their address, None as a null pointer, and numbers."""
        for name, value in values.items():
            if isinstance(value, np.ndarray):
                self.kept.append(np.ascontiguousarray(value, dtype=float))
                value = address(self.kept[-1])
            setattr(self.structure, name, value)


def plan_values(
    system: System, numbers: Sequence[str], L: np.ndarray
) -> dict[str, np.ndarray | float | None]:
    """Return the fields of ``struct plan`` that a model determines; those that do not apply are
    None.

    Args:
        system: the model.
        numbers: the attributes of the system that its code takes.
        L: process noise, shape (nx, m).
    """
    p, D, box = plant_numbers(system, numbers), L @ L.T, system.state_box
    breaks = np.sort(np.asarray(system.breakpoints(), dtype=float))
    measured = {"previous": 1, "linear": 2}[system.input_hold]
    return {
        "p": p,
        "p_rows": int(p.ndim > 1),
        "L": L,
        "m": L.shape[1],
        "D": D,
        "diagonal": int(not (D - np.diag(np.diag(D))).any()),
        "longest": longest_step(system),
        "breaks": breaks,
        "num_breaks": len(breaks),
        "input": measured if system.measured_input else 0,
        "discrete": int(system.discrete),
        "state_period": _periods(system.state_period),
        "output_period": _periods(system.output_period),
        "low": None if box is None else box.low,
        "high": None if box is None else box.high,
    }


def _periods(periods: Any) -> np.ndarray | None:
    return None if periods is None else np.array([period or 0.0 for period in periods])
