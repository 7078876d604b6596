"""Scores of estimators over several systems and their differences, with standard errors over
training seeds and episodes.

The statistic of a system is a mean over training seeds and episodes, trimmed or not. Its error is
that of the mean of its influence values (seeds, episodes), described by a two-way random-effects
model with crossed factors (Searle, Casella & McCulloch, "Variance Components", 1992, section 4.3):

    influence = effect of the seed + effect of the episode + rest,
    variance = var(means of seeds)/seeds + var(means of episodes)/episodes
               - mean square of the rest/(seeds·episodes).

The rest is subtracted because both variances of means contain it. The result is at least the larger
of the first two terms. Systems are independent. Degrees of freedom are Satterthwaite's ("An
approximate distribution of estimates of variance components", 1946), see `estimate`.

With one training seed the variance between seeds cannot be known, and its term is absent: the
result then holds for this one trained estimator, not for its training.

The 95 % interval of `score` was simulated for normal, Student t₃ and exponential effects, 1, 3 and
5 seeds, 20 to 100 episodes and 1 to 6 systems: it covers the truth in 93 to 99.8 % of repetitions,
most often where differences between seeds are by far the largest. With 2 seeds of one system it is
92 %. `coverage` of `scripts/null_test.py` repeats the check.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.leaderboard.influence import Influence, Results, divergence, interquartile_mean
from pinnobs_gym.leaderboard.intervals import CONFIDENCE, Interval

SEEDS_WEIGHT = 2.0
"""Factor of the seeds' terms in the degrees of freedom, see `estimate`."""
ROUNDING = 1e-9
"""Values up to this count as zero, so that estimators that are equal but for rounding tie."""


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error."""

    value: float
    standard_error: float
    """Infinite if a system has one episode, from which nothing can be told."""
    degrees: float
    """Degrees of freedom of the standard error; zero if it is infinite."""
    least_p: float = 0.0
    """The smallest p-value that the data can give, see `p_value`."""


def estimate(
    own: Mapping[str, Influence], other: Mapping[str, Influence] | None = None
) -> Estimate:
    """Return the mean over systems of a statistic, or of its difference between two estimators on
    the same episodes.

    Influence values of an episode are subtracted before the episodes' variance is taken; the terms
    of the estimators' seeds add. The episodes' term of a trimmed mean is Tukey & McLaughlin's
    ("Less vulnerable confidence and significance procedures for location based on a single sample",
    1963): the sum of squares of the winsorised values over k(k - 1), with k - 1 degrees of freedom
    for k untrimmed episodes.

    Satterthwaite's degrees are too many where few seeds happen to agree: their small variance then
    reduces its own weight. Seeds' terms therefore count `SEEDS_WEIGHT` times in the degrees, not in
    the variance. One system, 3 seeds, an untrained estimator as opponent: of simulated tests at
    the level 5 %, up to 7.7 % reject without this factor and up to 6 % with it.

    Raises:
        ValueError: in one line, if the two differ in systems or in numbers of episodes.
    """
    _check_comparable(own, other)
    value = float(np.mean([one.value for one in own.values()]))
    if other is not None:
        value -= float(np.mean([one.value for one in other.values()]))
    if any(len(one.means) < 2 for one in own.values()):
        return Estimate(value, np.inf, 0.0, 1.0)
    variance = weighted = squares = 0.0
    differing = 0
    for system, one in own.items():
        terms = _terms(one, None if other is None else other[system])
        variance += terms.variance
        weighted += terms.weighted
        squares += terms.squares
        differing += terms.differing
    degrees = weighted**2 / squares if squares > 0 else np.inf
    least_p = min(1.0, 2 * 0.5**differing)
    return Estimate(value, float(np.sqrt(variance)) / len(own), degrees, least_p)


@dataclass(frozen=True)
class _Terms:
    """What one system adds to the sums over systems in `estimate`."""

    variance: float
    weighted: float
    """The variance with the seeds' terms weighted: their sum is the root of Satterthwaite's
    numerator."""
    squares: float
    """Squares of the terms over their degrees of freedom: their sum is his denominator."""
    differing: int
    """Number of episodes on which the two estimators differ."""


def _terms(one: Influence, other: Influence | None) -> _Terms:
    """Return the terms of a system, of one estimator or of a difference."""
    sides = [one] if other is None else [one, other]
    influence, means = one.episodes, one.means
    if other is not None:
        influence, means = influence - other.episodes, means - other.means
    # The episodes' term. Its last factor is Tukey & McLaughlin's; without trimming it is 1.
    count, degrees = len(means), one.kept - 1
    episodes = float(influence.var(ddof=1)) / count * (count - 1) / count * one.kept / degrees
    # The variance, with the seeds' terms of all sides.
    seeds = sum(side.seeds_variance for side in sides)
    rest = sum(side.rest_variance for side in sides)
    variance = max(seeds + episodes - rest, seeds, episodes)
    # Satterthwaite's sums. With one training seed the terms of seeds and rest are zero.
    squares = episodes**2 / degrees
    for side in sides:
        of_seeds, of_rest = SEEDS_WEIGHT * side.seeds_variance, side.rest_variance
        squares += (of_seeds**2 + of_rest**2 / degrees) / max(side.num_seeds - 1, 1)
    weighted = variance + (SEEDS_WEIGHT - 1) * seeds
    return _Terms(variance, weighted, squares, int(np.sum(np.abs(means) > ROUNDING)))


def _check_comparable(own: Mapping[str, Influence], other: Mapping[str, Influence] | None) -> None:
    """Refuse estimators without systems, or with other systems or episodes than each other's."""
    if not own:
        raise ValueError("no systems are given; expected at least one")
    if other is None:
        return
    if set(own) != set(other):
        raise ValueError(f"systems are {sorted(own)} and {sorted(other)}; expected the same")
    for system, one in own.items():
        if len(one.means) != len(other[system].means):
            raise ValueError(
                f"numbers of episodes of {system} are {len(one.means)} and "
                f"{len(other[system].means)}; expected the same"
            )


def score(results: Mapping[str, Results]) -> Estimate:
    """Return the log of an estimator's score: of the geometric mean over systems of exp of the
    interquartile mean of log ratios, over all training seeds and episodes of the system.

    Args:
        results: by system.
    """
    return estimate({system: interquartile_mean(one) for system, one in results.items()})


def difference(a: Mapping[str, Results], b: Mapping[str, Results]) -> Estimate:
    """Return the `score` of one estimator minus that of another, paired by episode.

    Raises:
        ValueError: in one line, if they differ in systems or in numbers of episodes.
    """
    return estimate(
        {system: interquartile_mean(one) for system, one in a.items()},
        {system: interquartile_mean(one) for system, one in b.items()},
    )


def divergence_difference(a: Mapping[str, Results], b: Mapping[str, Results]) -> Estimate:
    """Return the mean over systems of the rate of divergence of one estimator minus that of
    another, paired by episode.

    Raises:
        ValueError: in one line, if they differ in systems or in numbers of episodes.
    """
    return estimate(
        {system: divergence(one) for system, one in a.items()},
        {system: divergence(one) for system, one in b.items()},
    )


def p_value(estimate: Estimate) -> float:
    """Return the two-sided p-value of Student's t test that a value is zero.

    The approximation is poor for few episodes, and meaningless where none of them varies, such as
    three episodes that all diverge against three that do not. The result is therefore at least the
    smallest that the exact sign test could give, 2·0.5ᵏ with the number k of episodes, of all
    systems, on which the two estimators differ. For divergence this is the smallest p-value of
    McNemar's exact test with k discordant pairs. The result is 1 if the value is zero (up to
    `ROUNDING`) or nothing can be told.
    """
    if abs(estimate.value) <= ROUNDING or np.isinf(estimate.standard_error):
        return 1.0
    if estimate.standard_error == 0:
        return estimate.least_p
    from scipy.special import stdtr

    t = abs(estimate.value) / estimate.standard_error
    return max(2 * float(stdtr(estimate.degrees, -t)), estimate.least_p)


def interval(estimate: Estimate) -> Interval:
    """Return an estimate with its 95 % interval, which may be unbounded or, where nothing but
    rounding varies, empty."""
    if not np.isfinite(estimate.standard_error) or estimate.least_p > 1 - CONFIDENCE:
        return Interval(estimate.value, -np.inf, np.inf)
    if estimate.standard_error <= ROUNDING:
        return Interval(estimate.value, estimate.value, estimate.value)
    from scipy.special import stdtrit  # scipy.stats takes long to import

    half = float(stdtrit(estimate.degrees, (1 + CONFIDENCE) / 2)) * estimate.standard_error
    return Interval(estimate.value, estimate.value - half, estimate.value + half)
