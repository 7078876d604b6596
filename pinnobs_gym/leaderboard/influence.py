"""The statistics of one estimator in one system, with all that their variances depend on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

TRIMMED = 0.25
"""Part of the values trimmed at either end."""
SMALLEST = 1e-12
"""Smallest NRMSE that counts, of an estimate that is exact."""


@dataclass(frozen=True)
class Results:
    """One estimator's results of one system.

    Raises:
        ValueError: in one line, if the arrays are empty or of different shapes, or a log ratio is
            not finite.
    """

    log_ratio: np.ndarray
    """log of its capped NRMSE over the peer's on the same episode, shape (training seeds,
    episodes), finite."""
    diverged: np.ndarray
    """Whether the episode diverged, bool, same shape."""

    def __post_init__(self) -> None:
        shape = np.shape(self.log_ratio)
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"log_ratio has shape {shape}; expected (training seeds, episodes)")
        if np.shape(self.diverged) != shape:
            raise ValueError(f"diverged has shape {np.shape(self.diverged)}; expected {shape}")
        bad = np.asarray(self.log_ratio)[~np.isfinite(self.log_ratio)]
        if len(bad):
            raise ValueError(f"log_ratio contains {bad[0]}; expected finite values")


Field = Mapping[str, Mapping[str, Results]]
"""Results by estimator and system. All estimators have the same systems and, in a system, the same
episodes in the same order; their numbers of training seeds may differ."""


@dataclass(frozen=True)
class Influence:
    """One estimator's statistic in one system, with all that its error depends on."""

    value: float
    """The statistic."""
    means: np.ndarray
    """Values averaged over training seeds, shape (episodes,)."""
    episodes: np.ndarray
    """Influence values averaged over training seeds, shape (episodes,)."""
    kept: int
    """Number of episodes without the trimmed ones."""
    num_seeds: int
    seeds_variance: float
    """Variance of the seeds' means over the number of seeds; zero with one seed."""
    rest_variance: float
    """Mean square of the rest over the number of values; zero with one seed."""


def interquartile_mean(results: Results) -> Influence:
    """Return the mean of the log ratios without the lowest and the highest quarter.

    Influence values are the winsorised values' deviations from their mean, divided by the part that
    is kept (Wilcox, "Introduction to Robust Estimation and Hypothesis Testing", section 3.3).
    """
    values = np.asarray(results.log_ratio, dtype=float)
    count, episodes = values.size, values.shape[1]
    cut = int(TRIMMED * count)
    ordered = np.sort(values, axis=None)
    winsorised = np.clip(values, ordered[cut], ordered[count - cut - 1])
    scaled = (winsorised - winsorised.mean()) * (count / (count - 2 * cut))
    kept = episodes - 2 * int(TRIMMED * episodes)
    return _influence(float(ordered[cut : count - cut].mean()), values, scaled, kept)


def divergence(results: Results) -> Influence:
    """Return the rate of divergence."""
    values = np.asarray(results.diverged, dtype=float)
    return _influence(float(values.mean()), values, values - values.mean(), values.shape[1])


def log_rms_ratio(error: np.ndarray, floor: np.ndarray) -> Influence:
    """Return the log of the root mean square of errors over that of their floor.

    A few episodes often make up most of both mean squares, and the linearised statistic then has
    too small a variance. Influence values of episodes are therefore those of the jackknife (Efron &
    Stein, "The jackknife estimate of variance", 1981), and as many episodes are kept as of equal
    squares would weigh the same, (Σw)²/Σw². In simulations with one training and 10 to 100 episodes
    of lognormal squared floors (deviation of the log 0.7 to 1.8) and ratios (0.3 to 0.8), the 95 %
    interval covers the truth in 91 to 99 % of repetitions; the linearised one in 67 to 94 %.

    Args:
        error: shape (training seeds, episodes), finite and not all zero.
        floor: of the same episodes, shape (episodes,), finite and not all zero.
    """
    own, least = np.square(error), np.square(floor)
    value = float(np.log(own.mean()) - np.log(least.mean())) / 2
    linear = (own / own.mean() - least / least.mean()) / 2
    excess = (own - least) / least.mean()  # zero on episodes without a difference
    # What each episode contributes to both sums; 1 is left out, since nothing would remain.
    part, least_part = own.sum(axis=0) / own.sum(), least / least.sum()
    logs = [np.log1p(-np.minimum(each, 1 - 1e-12)) for each in (part, least_part)]
    jackknife = len(floor) / 2 * (logs[1] - logs[0])
    kept = max(2, round(1 / np.sum(((part + least_part) / 2) ** 2)))
    return replace(_influence(value, excess, linear, kept), episodes=jackknife)


def _influence(value: float, values: np.ndarray, scaled: np.ndarray, kept: int) -> Influence:
    """Return the components of the two-way model of influence values (seeds, episodes)."""
    seeds, episodes = scaled.shape
    by_episode, by_seed = scaled.mean(axis=0), scaled.mean(axis=1)
    seeds_variance = rest_variance = 0.0
    if seeds > 1:
        seeds_variance = float(by_seed.var(ddof=1)) / seeds
    if seeds > 1 and episodes > 1:
        rest = scaled - by_episode - by_seed[:, None] + by_seed.mean()
        mean_square = float(np.sum(rest**2)) / ((seeds - 1) * (episodes - 1))
        rest_variance = mean_square / (seeds * episodes)
    means = values.mean(axis=0)
    return Influence(value, means, by_episode, kept, seeds, seeds_variance, rest_variance)
