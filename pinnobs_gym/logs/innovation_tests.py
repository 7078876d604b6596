"""Tests of whether normalised innovations are white, and as large as their covariances say.

If the model and its noise are right, the innovations of a filter are independent, and each over its
standard deviation is standard normal (Bar-Shalom, Li & Kirubarajan 2001, section 5.4). Everything
here is judged by medians, bounded values and counts, which neither a few outliers nor the start
decide. Functions of `scipy.special` are imported where they are used, since that takes long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CONFIDENCE = 0.95
"""Probability of the bands that are shown."""
_BOUNDED = 3.0
"""Number of robust standard deviations to which values are cut for correlations."""
_LONGEST_STEP = 2.0
"""Largest step between two samples that are neighbours, over the median step."""
_BLOCKS = 16
"""Least number of blocks whose means are compared."""


@dataclass(frozen=True)
class Size:
    """The size of squares that should follow χ²."""

    median: float
    """Median of the squares over the median of their χ²: 1 if the covariances are right."""
    low: float
    """Lower end of the band of that median."""
    high: float
    """Upper end of the band of that median."""
    chance: float
    """Probability that a right model gives so many squares on one side of 1, or more."""


@dataclass(frozen=True)
class Correlation:
    """The correlation of each value with the next."""

    value: float
    """From -1 to 1; 0 if values are white. NaN without neighbours."""
    band: float
    """Half width of the band about 0."""
    chance: float
    """Probability of one so large in size if values are white."""


@dataclass(frozen=True)
class Drift:
    """The means of blocks of values."""

    ratio: float
    """Variance of these means over that which they have if values are white."""
    length: int
    """Number of values in a block."""
    chance: float
    """Probability of a ratio so large, over all lengths tried."""


def size_of(squares: np.ndarray, degrees: np.ndarray) -> Size:
    """Judge squares (n,), each of which should follow χ² with its degrees of freedom (n,).

    The median is judged by a sign test: the number of squares above the median of their χ² is
    binomial. The band is that of the median of n independent values, whose probability transform
    follows the beta distribution of an order statistic (David & Nagaraja 2003, section 2.1), at the
    commonest number of degrees. For n both use `effective_number` of the signs.
    """
    from scipy.special import betainc, betaincinv, gammaincinv

    ratios = squares / (2 * gammaincinv(degrees / 2, 0.5))
    above = ratios > 1
    number = effective_number(above)
    fewer = min(above.mean(), 1 - above.mean()) * number
    chance = float(min(1.0, 2 * betainc(number - fewer, fewer + 1, 0.5)))
    half = (number + 1) / 2
    quantiles = betaincinv(half, half, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    values, counts = np.unique(degrees, return_counts=True)
    shape = values[np.argmax(counts)] / 2
    low, high = gammaincinv(shape, quantiles) / gammaincinv(shape, 0.5)
    return Size(float(np.median(ratios)), float(low), float(high), chance)


def effective_number(values: np.ndarray) -> float:
    """Return the number of independent values whose mean is as uncertain as that of the values
    (n,): n/(1 + 2Σρ) with their autocorrelations ρ up to where the sum of two neighbours falls
    below zero (Geyer 1992, "Practical Markov chain Monte Carlo", section 3.3); at most n."""
    number = len(values)
    centred = values - values.mean()
    if number < 4 or not centred.any():
        return float(number)
    # Correlations at all lags by the Fourier transform, padded so that the ends do not meet.
    spectrum = np.fft.rfft(centred, 2 * number)
    products = np.fft.irfft(abs(spectrum) ** 2)[: number - number % 2]
    pairs = (products / products[0]).reshape(-1, 2).sum(axis=1)
    ends = np.flatnonzero(pairs <= 0)
    total = pairs[: ends[0] if len(ends) else None].sum()
    return number / max(1.0, 2 * total - 1)


def correlation_of(values: np.ndarray, t: np.ndarray) -> Correlation:
    """Return the correlation of values (n,) at times t (n,) with the next, where the next one is
    not beyond a gap.

    Of n pairs of white values it is nearly normal with variance 1/n (Bar-Shalom, Li & Kirubarajan
    2001, section 5.4.2).
    """
    from scipy.special import ndtr, ndtri

    cut, steps = bounded(values), np.diff(t)
    near = steps <= _LONGEST_STEP * np.median(steps)
    now, later = cut[:-1][near], cut[1:][near]
    scale = np.sqrt((now @ now) * (later @ later))
    if not scale > 0:
        return Correlation(np.nan, np.nan, 1.0)
    value, number = float(now @ later / scale), int(near.sum())
    band = float(ndtri((1 + CONFIDENCE) / 2)) / np.sqrt(number)
    return Correlation(value, band, float(2 * ndtr(-abs(value) * np.sqrt(number))))


def drift_of(values: np.ndarray) -> Drift:
    """Return the drift of values (n,) at the length of blocks, 4, 16, 64, ..., where it is largest.

    The means of N blocks of m white values with variance s² have the variance s²/m; N times the
    ratio of the two follows χ² with N degrees of freedom. With a long memory it is the sum 1 + 2Σρ
    of autocorrelations (the variance ratio of Lo & MacKinlay 1988), which shows a model that is
    slowly wrong where the correlation with the next value is still small.
    """
    from scipy.special import gammaincc

    cut = bounded(values)
    variance, found = float(np.mean(cut**2)), []
    length = 4
    while len(values) // length >= _BLOCKS and variance > 0:
        count = len(values) // length
        means = cut[: count * length].reshape(count, length).mean(axis=1)
        ratio = length * float(np.mean(means**2)) / variance
        found.append(Drift(ratio, length, float(gammaincc(count / 2, count * ratio / 2))))
        length *= 4
    if not found:
        return Drift(1.0, 1, 1.0)
    largest = max(found, key=lambda drift: drift.ratio)
    chance = min(1.0, largest.chance * len(found))
    return Drift(largest.ratio, largest.length, chance)


def robust_std(values: np.ndarray) -> float:
    """Return the standard deviation of normal values of mean zero, from their median size."""
    return float(np.median(abs(values))) / 0.6745


def bounded(values: np.ndarray) -> np.ndarray:
    """Return values cut at some robust standard deviations, so that outliers do not hide the
    correlation of the others."""
    most = _BOUNDED * robust_std(values)
    return np.clip(values, -most, most) if most > 0 else values
