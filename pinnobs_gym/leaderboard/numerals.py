"""Numbers as the tables show them."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.leaderboard.intervals import Interval


def number(value: float, digits: int = 3) -> str:
    """Format a score with this number of significant digits."""
    if not np.isfinite(value):
        return "∞"
    if abs(value) >= 10**digits:
        return f"{value:.0f}" if abs(value) < 1e5 else f"{value:.1e}"
    return f"{value:.{digits}g}"


def optional(value: float | None, digits: int = 3) -> str:
    """Format a score as `number` does; an empty text if there is none."""
    return "" if value is None else number(value, digits)


def interval_text(interval: Interval, digits: int = 3) -> str:
    """Format a number to this number of significant digits with its interval, unless they are
    equal."""
    if interval.low == interval.high:
        return number(interval.value, digits)
    return (
        f"{number(interval.value, digits)} ({number(interval.low, 2)}–{number(interval.high, 2)})"
    )
