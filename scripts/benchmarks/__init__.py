"""Groups of measured figures; each group is a module with a function ``figures(repeats)``."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Figure:
    """One measured figure."""

    figure: str
    value: float
    unit: str
    asked: str
    holds: bool | None
    """Whether the bound holds; None without a bound."""


def at_least(figure: str, value: float, unit: str, bound: float | None) -> Figure:
    """Return a figure with a lower bound, or without a bound."""
    asked = "" if bound is None else f">= {bound:g}"
    return Figure(figure, value, unit, asked, None if bound is None else bool(value >= bound))


def at_most(figure: str, value: float, unit: str, bound: float) -> Figure:
    """Return a figure with an upper bound."""
    return Figure(figure, value, unit, f"<= {bound:g}", bool(value <= bound))


def cpu_seconds(run: Callable[[], object]) -> float:
    """Measure the CPU time of a call in s."""
    start = time.process_time()
    run()
    return time.process_time() - start


def median_ratio(peer: Callable[[], object], own: Callable[[], object], repeats: int) -> float:
    """Return the median ratio of the peer's CPU time to our own, measured alternately."""
    peer()  # the first calls fill caches
    own()
    return float(np.median([cpu_seconds(peer) / cpu_seconds(own) for _ in range(repeats)]))
