"""Bounds of states, such as a concentration that is never below zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import System

Bounds: TypeAlias = Sequence[float | None]
"""One bound per state, in its unit; None where a state has none."""

TOLERANCE = 1e-8
"""How far beyond a bound, relative to its scale, a state of the truth counts as within."""


@dataclass(frozen=True, eq=False)
class StateBox:
    """The states within the bounds, which themselves belong to it."""

    low: np.ndarray
    """Lower bounds, shape (nx,); −∞ where there is none."""
    high: np.ndarray
    """Upper bounds, shape (nx,); ∞ where there is none."""

    @property
    def bounded(self) -> np.ndarray:
        """Which states have a bound, bool (nx,)."""
        return np.isfinite(self.low) | np.isfinite(self.high)

    def clipped(self, x: np.ndarray) -> np.ndarray:
        """Return the states x (..., nx) with each component moved to the bound that it exceeds."""
        return np.clip(x, self.low, self.high)

    def outside(self, x: np.ndarray) -> np.ndarray:
        """Return which of the states x (..., nx) exceed a bound, bool (...)."""
        beyond: np.ndarray = np.any((x < self.low) | (x > self.high), axis=-1)
        return beyond


def beyond(system: System, x: np.ndarray) -> str | None:
    """Return in words which of the states x (..., nx) of a system exceeds its bound most, relative
    to its scale; None if none does by more than `TOLERANCE`."""
    box = system.state_box
    if box is None or not box.outside(x).any():
        return None
    rows, size = x.reshape(-1, system.nx), np.asarray(system.scale, dtype=float)
    over = np.stack([box.low - rows, rows - box.high]) / size
    over = np.where(np.isfinite(rows), over, -np.inf)
    side, row, i = np.unravel_index(np.argmax(over), over.shape)
    if over[side, row, i] <= TOLERANCE:
        return None
    what = f"above state_high={box.high[i]:g}" if side else f"below state_low={box.low[i]:g}"
    return f"{system.state_names[i]} comes to {rows[row, i]:.6g}, {what}"


def absorbed(x: np.ndarray, box: StateBox | None) -> np.ndarray:
    """Return the states x (..., nx) of a plant with process noise, of which those that the noise
    moved beyond a bound are at that bound, where they stay until f or the noise moves them back.
    States that are not finite remain, so that a plant that diverges is not hidden."""
    if box is None or not box.outside(x).any():
        return x
    return np.where(np.isfinite(x), box.clipped(x), x)


def box(low: Bounds | None, high: Bounds | None, nx: int) -> StateBox | None:
    """Return the box of bounds, or None if no state has one.

    Raises:
        ValueError: in one line, if there are not as many bounds as states, one is no number, or a
            lower bound is not below the upper one.
    """
    if low is None and high is None:
        return None
    for name, given in (("state_low", low), ("state_high", high)):
        if given is not None and not isinstance(given, tuple | list):
            raise ValueError(
                f"{name}={given!r}; expected a number for each of {nx} states, None for no bound"
            )
    return _made(low if low is None else tuple(low), high if high is None else tuple(high), nx)


@lru_cache(maxsize=64)
def _made(
    low: tuple[float | None, ...] | None, high: tuple[float | None, ...] | None, nx: int
) -> StateBox | None:
    sides = []
    for name, given, missing in (("state_low", low, -np.inf), ("state_high", high, np.inf)):
        bounds = (None,) * nx if given is None else given
        if len(bounds) != nx:
            raise ValueError(f"{name} has {len(bounds)} bounds; expected {nx}, None for no bound")
        for bound in bounds:
            number = isinstance(bound, int | float | np.number) and not isinstance(bound, bool)
            if bound is not None and (not number or np.isnan(bound)):
                raise ValueError(f"{name}={bounds}; expected numbers, None for no bound")
        side = np.array([missing if bound is None else bound for bound in bounds], dtype=float)
        side.flags.writeable = False
        sides.append(side)
    wrong = np.flatnonzero(~(sides[0] < sides[1]))
    if len(wrong):
        i = wrong[0]
        raise ValueError(
            f"state_low={sides[0][i]:g} of state {i + 1} is not below state_high={sides[1][i]:g}"
        )
    return StateBox(*sides) if np.isfinite(sides).any() else None
