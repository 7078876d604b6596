"""Differences of values some of which are angles, or repeat with another period.

Functions take NumPy arrays and torch tensors, and preserve gradients. ``periods`` is None, or has
an entry for each component of the last axis: its period in its unit, or None.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace

Periods: TypeAlias = Sequence[float | None]
"""The period of each component, in its unit; None for a component that does not repeat."""


def residual(a: Any, b: Any, periods: Periods | None) -> Any:
    """Return a − b (..., n), with components that repeat wrapped into [−period/2, period/2)."""
    difference = a - b
    return difference if periods is None else _replaced(difference, difference, periods, _wrapped)


def nearest(values: Any, reference: Any, periods: Periods | None) -> Any:
    """Return the values (..., n), in which components that repeat are moved by whole periods to
    within half a period of the reference, which broadcasts against the values."""
    if periods is None:
        return values
    return _replaced(values, values - reference, periods, _moved)


def check_periods(periods: Periods | None, size: int, name: str) -> None:
    """Check what a system declares.

    Raises:
        ValueError: in one line, unless it is None or has ``size`` entries, each None or a positive
            number.
    """
    if periods is None:
        return
    if not isinstance(periods, tuple | list) or len(periods) != size:
        raise ValueError(f"{name}={periods!r}; expected None or {size} entries")
    for period in periods:
        number = isinstance(period, int | float | np.number) and not isinstance(period, bool)
        if period is not None and not (number and 0 < period < np.inf):
            raise ValueError(f"{name}={periods!r}; expected None or positive numbers as entries")


def _replaced(values: Any, differences: Any, periods: Periods, change: Any) -> Any:
    """Return the values with ``change(value, difference, period)`` in the components that
    repeat."""
    if isinstance(values, np.ndarray):
        out = values.copy(order="K")  # the order of a sum depends on the order in memory
        with np.errstate(invalid="ignore"):  # values that are not finite give NaN
            for i, period in enumerate(periods):
                if period is not None:
                    out[..., i] = change(values[..., i], differences[..., i], period)
        return out
    parts = [
        values[..., i] if period is None else change(values[..., i], differences[..., i], period)
        for i, period in enumerate(periods)
    ]
    return array_namespace(values).stack(parts, axis=-1)


def _wrapped(value: Any, difference: Any, period: float) -> Any:
    """Return a difference in [−period/2, period/2); one that is there already is unchanged."""
    xp, half = array_namespace(difference), period / 2
    rest = xp.remainder(difference, period)
    rest = xp.where(rest >= half, rest - period, rest)
    return xp.where((-half <= difference) & (difference < half), difference, rest)


def _moved(value: Any, difference: Any, period: float) -> Any:
    """Return the value less whole periods; it is unchanged if the difference is within half of
    one."""
    turns = array_namespace(difference).floor(difference / period + 0.5)
    return value - period * turns
