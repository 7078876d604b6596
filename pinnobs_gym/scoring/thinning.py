"""Which samples of an episode curves keep, and in how many digits."""

from __future__ import annotations

import numpy as np

POINTS = 200
"""Most sample times at which errors are kept."""
EARLY, EVEN = 50, 250
"""Samples kept of the example episode: its first ones, and ones spread evenly."""


def kept(num_samples: int, points: int = POINTS) -> np.ndarray:
    """The indices of the samples that are kept, ascending: all if there are at most ``points``;
    else half of them evenly and half of them by the logarithm, so that the transient is resolved
    and the rest is not lost."""
    if num_samples <= points:
        return np.arange(num_samples)
    half = points // 2
    early = np.geomspace(1, num_samples, half) - 1
    even = np.linspace(0, num_samples - 1, half)
    return np.unique(np.round(np.concatenate([early, even])).astype(int))


def kept_of_example(num_samples: int) -> np.ndarray:
    """The indices of the samples of the example episode that are kept, ascending: the first `EARLY`
    and `EVEN` spread evenly."""
    even = np.linspace(0, num_samples - 1, min(EVEN, num_samples)).round().astype(int)
    return np.union1d(np.arange(min(EARLY, num_samples)), even)


def rounded(values: np.ndarray) -> np.ndarray:
    """The values in float32, rounded to 12 binary digits, so that they compress well; what is too
    large is infinite."""
    with np.errstate(over="ignore"):
        bits = np.ascontiguousarray(values, dtype=np.float32).view(np.uint32)
    return ((bits + np.uint32(0x800)) & np.uint32(0xFFFFF000)).view(np.float32)
