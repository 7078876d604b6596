"""Statistics with confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import sqrt
from statistics import NormalDist

import numpy as np

CONFIDENCE = 0.95
"""Confidence level of every interval."""
REPLICATES = 2000
"""Number of bootstrap replicates."""


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
    from scipy.special import bdtr  # scipy.stats takes long to import

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


def log_ratio(score: np.ndarray, peer: np.ndarray) -> np.ndarray:
    """Return log(score/peer) for the same episodes; zero for a tie, including two infinite
    scores."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(score) - np.log(peer)
    return np.where(score == peer, 0.0, ratio)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """Return the mean over the last axis without the lowest and the highest quarter (Agarwal et al.
    2021).

    Infinite values are trimmed like the others. The mean is infinite if more values are infinite on
    one side than are trimmed there, and NaN if this holds on both sides.
    """
    from scipy.stats import trim_mean

    with np.errstate(invalid="ignore"):
        return np.asarray(trim_mean(values, 0.25, axis=-1))


def improvement(values: np.ndarray) -> np.ndarray:
    """Return the fraction of log ratios below zero over the last axis, a tie counting half: the
    probability that a score is better than the peer's on the same episode."""
    return np.mean((values < 0) + 0.5 * (values == 0), axis=-1)


def bootstrapped(
    strata: Sequence[np.ndarray], statistic: Callable[[np.ndarray], np.ndarray], seed: int = 0
) -> Interval:
    """Return a statistic of all values of several strata with its interval from a stratified
    bootstrap.

    In every stratum, training seeds and episodes are resampled with replacement independently of
    each other: a replicate holds the drawn seeds on the drawn episodes (Efron & Tibshirani 1993,
    section 13.3, for percentiles; Agarwal et al. 2021 for strata).

    Args:
        strata: one array (training seeds, episodes) per system.
        statistic: a function of values (..., n) over the last axis.
        seed: of the draws.
    """
    rng = np.random.default_rng(seed)
    drawn = []
    for values in strata:
        # Resample rows and columns of each stratum.
        seeds, episodes = (rng.integers(0, size, (REPLICATES, size)) for size in values.shape)
        drawn.append(values[seeds[:, :, None], episodes[:, None]].reshape(REPLICATES, -1))
    # Percentile interval of the replicates' statistics.
    replicates = np.sort(statistic(np.concatenate(drawn, axis=1)))
    tail = int((1 - CONFIDENCE) / 2 * REPLICATES)
    value = statistic(np.concatenate([values.ravel() for values in strata]))
    return Interval(float(value), float(replicates[tail]), float(replicates[-1 - tail]))
