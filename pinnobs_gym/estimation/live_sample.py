"""The check of one sample of a live filter, which takes a fraction of a microsecond."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import LARGEST, shortly

_REAL = "biuf"
"""Kinds of NumPy's types that are real numbers."""


class Sample(NamedTuple):
    """A sample of one plant."""

    t: float
    """Time in s."""
    y: list[float]
    """Outputs (ny,); NaN marks a missing one."""
    u: list[float] | None
    """Inputs (nu,); None for those that the system defines."""


def sample_of(system: System, t: Any, y: Any, u: Any) -> Sample:
    """Return a sample; the arguments are those of `pinnobs_gym.estimation.live.Live.update`.

    Raises:
        ValueError: in one line that names the value and what was expected.
    """
    if type(t) is not float or t - t != 0.0:
        t = _time(system, t)
    return Sample(t, _values(system, "y", y, system.ny), inputs_of(system, u))


def inputs_of(system: System, u: Any) -> list[float] | None:
    """Return the inputs of a sample, None for those that the system defines.

    Raises:
        ValueError: in one line that names the value and what was expected.
    """
    if u is not None:
        return _values(system, "u", u, system.nu)
    if system.measured_input and system.nu:
        raise ValueError(
            f"u is missing; {type(system).__name__} has {system.nu} measured input(s), expected "
            "their values at each sample"
        )
    return None


def _values(system: System, name: str, value: Any, count: int) -> list[float]:
    """Return the outputs or the inputs of a sample. What is usual is recognised without NumPy,
    whose functions take longer than a filter."""
    try:
        values = value.tolist() if type(value) is np.ndarray else value
        if type(values) is not list:
            values = values if type(values) is tuple else (values,)
        if len(values) == count and (isinstance(sum(values), float) or not count):
            for each in values:
                if not -LARGEST <= each <= LARGEST and (each == each or name != "y"):
                    break
            else:
                return [*values]
    except TypeError:  # of what are no numbers
        pass
    return _unusual(system, name, value, count)


def _unusual(system: System, name: str, value: Any, count: int) -> list[float]:
    """Return the same of values that may be missing, masked, huge, or none at all."""
    try:
        if name == "y" and isinstance(value, np.ma.MaskedArray) and value.dtype.kind in _REAL:
            value = np.ma.filled(value.astype(float), np.nan)
        array = np.asarray(value)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.size and array.dtype.kind not in _REAL:
        hint = ", NaN if it is missing" if name == "y" else ""
        raise ValueError(f"{name}={shortly(value)}; expected {count} number(s){hint}")
    if array.shape != (count,) and not (count == 1 and array.ndim == 0):
        raise ValueError(
            f"{name} has shape {array.shape}; {type(system).__name__} has n{name}={count}, "
            f"expected ({count},)"
        )
    values: list[float] = array.astype(float).reshape(count).tolist()
    for i, each in enumerate(values):
        if not abs(each) <= LARGEST and not (math.isnan(each) and name == "y"):
            hint = ", or NaN if it is missing" if name == "y" else ""
            expected = f"a finite number up to {LARGEST:g}{hint}"
            raise ValueError(f"{name}{i + 1}={each}; expected {expected}")
    return values


def _time(system: System, t: Any) -> float:
    """Return a time that is no usual number."""
    array = np.asarray(t)
    if array.ndim or array.dtype.kind not in "iuf" or not np.isfinite(array):
        raise ValueError(f"t={shortly(t)}; expected a finite number of {system.time_unit}")
    return float(array)


def check_after(t: float, before: float, longest_gap: float, unit: str) -> None:
    """Check that a sample follows another one soon enough, all in a unit of time.

    Raises:
        ValueError: in one line with both times and the longest gap.
    """
    if not t - before <= longest_gap:
        raise ValueError(
            f"t={t:.15g} {unit} is {t - before:.3g} {unit} after t={before:.15g} {unit}; expected "
            f"at most longest_gap={longest_gap:g} {unit}, with all times of one clock and in {unit}"
        )
