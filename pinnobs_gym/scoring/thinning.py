"""Thinning of an episode's samples for stored curves, and rounding of their values."""

from __future__ import annotations

import numpy as np

POINTS = 200
"""Largest number of sample times at which errors are kept."""
EARLY, EVEN = 50, 250
"""Numbers of samples kept of the example episode: at its beginning, and evenly spread."""


def kept(num_samples: int, points: int = POINTS) -> np.ndarray:
    """Return the indices of the samples that are kept, ascending.

    These are all samples if there are at most ``points``. Otherwise half of them are spread evenly
    and half logarithmically, which resolves the transient and covers the rest.
    """
    if num_samples <= points:
        return np.arange(num_samples)
    half = points // 2
    early = np.geomspace(1, num_samples, half) - 1
    even = np.linspace(0, num_samples - 1, half)
    return np.unique(np.round(np.concatenate([early, even])).astype(int))


def kept_of_example(num_samples: int) -> np.ndarray:
    """Return the indices of the samples of the example episode that are kept, ascending: the first
    `EARLY`, and `EVEN` spread evenly."""
    even = np.linspace(0, num_samples - 1, min(EVEN, num_samples)).round().astype(int)
    return np.union1d(np.arange(min(EARLY, num_samples)), even)


def rounded(values: np.ndarray) -> np.ndarray:
    """Return the values in float32, rounded to 12 significant binary digits so that they compress
    well; values too large are infinite."""
    with np.errstate(over="ignore"):
        bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    return ((bits + np.uint32(0x800)) & np.uint32(0xFFFFF000)).view(np.float32)
