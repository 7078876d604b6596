"""Statistics with confidence intervals."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import sqrt
from statistics import NormalDist

import numpy as np

CONFIDENCE = 0.95
"""Confidence level of every interval."""


@dataclass(frozen=True)
class Interval:
    """A number with its confidence interval."""

    value: float
    low: float
    high: float

    @property
    def percent(self) -> Interval:
        """The interval in percent, rounded."""
        return Interval(*(float(round(100 * part)) for part in (self.value, self.low, self.high)))

    @property
    def exp(self) -> Interval:
        """The interval of the exponential."""
        with np.errstate(over="ignore"):
            return Interval(*(float(np.exp(part)) for part in (self.value, self.low, self.high)))


def median(values: np.ndarray) -> Interval:
    """Return the median with its distribution-free interval from order statistics (Conover,
    "Practical Nonparametric Statistics", section 3.2). Infinite values are allowed. With too few
    values the interval is their whole range."""
    ordered = np.sort(values)
    low = _lowest_rank(len(ordered))
    return Interval(float(np.median(ordered)), float(ordered[low]), float(ordered[-1 - low]))


@lru_cache(maxsize=1024)
def _lowest_rank(count: int) -> int:
    """Return the index, from either end of the ordered values, of the bounds of their median."""
    if 0.5**count > (1 - CONFIDENCE) / 2:
        return 0
    from scipy.special import bdtr  # it takes long to import, and scipy.stats longer

    cumulative = bdtr(np.arange(count + 1), count, 0.5)
    return max(int(np.searchsorted(cumulative, (1 - CONFIDENCE) / 2)) - 1, 0)


@lru_cache(maxsize=65536)
def rate(hits: int, count: int) -> Interval:
    """Return a proportion with Wilson's interval (Wilson, "Probable inference, the law of
    succession, and statistical inference", 1927)."""
    part, z2 = hits / count, NormalDist().inv_cdf((1 + CONFIDENCE) / 2) ** 2
    middle = (hits + z2 / 2) / (count + z2)
    half = sqrt(z2) / (count + z2) * sqrt(hits * (1 - part) + z2 / 4)
    low = 0.0 if hits == 0 else middle - half
    return Interval(part, low, 1.0 if hits == count else middle + half)
