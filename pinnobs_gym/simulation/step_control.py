"""The steps of a stiff plant between two samples, whose error is controlled in each row."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeAlias

import numpy as np

from pinnobs_gym.simulation.motion import Interval, check_steps
from pinnobs_gym.simulation.rosenbrock import Rows, rosenbrock
from pinnobs_gym.simulation.system import vector

STIFF_TOLERANCE = 1e-8
"""Largest local error of a step, relative to the larger of a state and its scale."""

_ATTEMPTS = 10_000
"""Number of steps tried between two samples after which a row counts as diverged."""
_SHORTEST = 1e-14
"""Shortest step, relative to the interval; a row that needs a shorter one counts as diverged."""
_DIVERGED = 1e9
"""Size of a state, relative to its scale, at which a row counts as diverged."""
_HALVES = 0.5 ** np.arange(12)
"""Lengths that are tried for the first step, over the longest."""

Step: TypeAlias = tuple[Rows, np.ndarray, np.ndarray]
"""The rows of a batch with their steps, and the states (..., nx) before and after."""


def controlled_steps(over: Interval, x: np.ndarray) -> Iterator[Step]:
    """Yield each step tried from x (..., nx) to the end of an interval: the rows with their steps,
    zero in those that stay, and the states before and after it. No step crosses a time at which f
    or the input jumps."""
    system, shape = over.system, x.shape[:-1]
    scale = vector(system.scale, system.nx, "scale")
    longest = system.model_step or np.inf
    t = np.broadcast_to(np.asarray(over.t0, dtype=float), shape).copy()
    end = np.broadcast_to(np.asarray(over.t1, dtype=float), shape)
    breaks = np.sort(np.asarray(system.breakpoints(), dtype=float))
    whole = end - t
    if system.model_step is not None:
        count = float(whole.max(initial=0.0)) / system.model_step
        check_steps(system, t, end, count, system.model_step)
    wanted = np.minimum(_first(over, x, scale, _piece(breaks, t, end)), longest)
    for _ in range(_ATTEMPTS):
        stop, last = _piece(breaks, t, end)
        step = np.minimum(wanted, stop - t)
        tried, off, largest = _tried(Rows(over, t, step, last), x, scale)
        good = off <= 1
        # A row whose state is too large, or whose step would have to be too short, ends here.
        lost = (step > 0) & np.where(good, largest >= _DIVERGED, step <= _SHORTEST * whole)
        taken = np.where(good | lost, step, 0.0)
        after = np.where(good[..., None], tried, x)
        after = np.where(lost[..., None], np.nan, after)
        yield Rows(over, t, taken, last), x, after
        x, ahead = after, t + taken
        ahead = np.where(stop - t - taken <= _SHORTEST * whole, stop, ahead)
        t = np.where(lost, end, ahead)
        if not (t < end).any():
            return
        # The error is of order 4 in the step, by the embedded method of order 3.
        factor = 0.9 * np.maximum(off, 1e-10) ** -0.25
        longer = step * np.minimum(np.maximum(factor, 0.1), 5.0)
        # A step that a jump has shortened says nothing against a longer one after it.
        wanted = np.where(good & (step < wanted), np.maximum(longer, wanted), longer)
        wanted = np.minimum(wanted, longest)
    x = np.where((t < end)[..., None], np.nan, x)
    yield Rows(over, t, np.zeros(shape)), x, x


def _tried(
    rows: Rows, x: np.ndarray, scale: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return states (..., nx) after a step from x (..., nx), its error over the tolerance, infinite
    if the result is of no use, and the largest state over its scale, (...) each."""
    with np.errstate(all="ignore"):  # a step may be too long for f to be finite
        tried, error = rosenbrock(rows, x)
        size = abs(tried)
        largest = (size / scale).max(axis=-1)
        size = np.maximum(np.maximum(abs(x), size), scale)
        off = (abs(error) / size).max(axis=-1) / STIFF_TOLERANCE
    return tried, np.where(np.isfinite(largest) & np.isfinite(off), off, np.inf), largest


def _first(
    over: Interval,
    x: np.ndarray,
    scale: np.ndarray,
    piece: tuple[np.ndarray, np.ndarray | float],
) -> np.ndarray:
    """Return the length in s of each row's first step, (...): the longest of the piece up to the
    next jump, its half, and so on, whose error is small enough. All are tried at once, which in a
    small batch takes the time of one."""
    stop, last = piece
    t = np.broadcast_to(np.asarray(over.t0, dtype=float), x.shape[:-1])
    halves = _HALVES.reshape(-1, *(1,) * t.ndim) * (stop - t)
    many = np.broadcast_to(x, (len(halves), *x.shape))
    _, off, _ = _tried(Rows(over, t, halves, last), many, scale)
    good = off <= 1
    good[-1] = True
    return np.take_along_axis(halves, good.argmax(axis=0)[None], axis=0)[0]


def _piece(
    breaks: np.ndarray, t: np.ndarray, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray | float]:
    """Return up to which time in s steps from times t (...) may go, at most to ``end`` (...), and
    the latest time at which f is evaluated; see `Rows.last`."""
    if not breaks.size:
        return end, np.inf
    ahead = np.append(breaks, np.inf)[np.searchsorted(breaks, t, side="right")]
    # At its end, a step has the left limit of what jumps there.
    return np.minimum(ahead, end), np.where(ahead <= end, np.nextafter(ahead, -np.inf), np.inf)
