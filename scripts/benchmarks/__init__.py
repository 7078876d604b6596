"""Groups of measured figures: one module each, with ``figures(repeats)``."""

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
    """None where nothing is asked."""


def at_least(figure: str, value: float, unit: str, bound: float | None) -> Figure:
    """A figure that should be large."""
    asked = "" if bound is None else f">= {bound:g}"
    return Figure(figure, value, unit, asked, None if bound is None else value >= bound)


def at_most(figure: str, value: float, unit: str, bound: float) -> Figure:
    """A figure that should be small."""
    return Figure(figure, value, unit, f"<= {bound:g}", value <= bound)


def cpu_seconds(run: Callable[[], object]) -> float:
    """CPU time of a call."""
    start = time.process_time()
    run()
    return time.process_time() - start


def median_ratio(peer: Callable[[], object], own: Callable[[], object], repeats: int) -> float:
    """The median of the peer's CPU time over one's own, the two taken in turn."""
    peer()  # the first call builds what is kept
    own()
    return float(np.median([cpu_seconds(peer) / cpu_seconds(own) for _ in range(repeats)]))
