import numpy as np
import pytest
from scipy.stats import binom, binomtest

from pinnobs_gym.leaderboard import intervals


def test_the_median_interval_is_the_textbook_one():
    # n = 100: the 40th and 61st smallest values; coverage 1 - 2 P(Binomial(100, 1/2) <= 39).
    interval = intervals.median(np.arange(1.0, 101.0))
    assert (interval.value, interval.low, interval.high) == (50.5, 40.0, 61.0)
    assert 1 - 2 * binom.cdf(39, 100, 0.5) >= 0.95 > 1 - 2 * binom.cdf(40, 100, 0.5)


def test_the_median_interval_covers_as_often_as_it_says():
    rng = np.random.default_rng(0)
    samples = rng.exponential(size=(2000, 25))
    inside = [
        m.low <= np.log(2) <= m.high for m in (intervals.median(sample) for sample in samples)
    ]
    assert 0.94 <= np.mean(inside) <= 0.99


def test_infinite_scores_stay_in_the_median():
    interval = intervals.median(np.array([1.0, np.inf, 2.0, np.inf, np.inf]))
    assert np.isinf(interval.value)
    assert interval.low == 1.0


def test_wilsons_interval():
    # Wilson 1927 as in Newcombe 1998, table I: 15 of 148, 95 %: 0.0624 to 0.1605.
    interval = intervals.rate(15, 148)
    assert interval.low == pytest.approx(0.0624, abs=5e-5)
    assert interval.high == pytest.approx(0.1605, abs=5e-5)


@pytest.mark.parametrize(("hits", "count"), [(0, 1), (0, 7), (7, 7), (3, 20), (999, 1000)])
def test_wilsons_interval_is_scipys(hits, count):
    peer = binomtest(hits, count).proportion_ci(0.95, method="wilson")
    own = intervals.rate(hits, count)
    assert (own.low, own.high) == pytest.approx((peer.low, peer.high), abs=1e-14)


@pytest.mark.parametrize("count", [1, 2, 5, 6, 9, 20, 100, 1001, 20_000])
def test_the_ranks_of_the_median_are_scipys(count):
    rank = max(int(binom.ppf(0.025, count, 0.5)), 1)
    assert intervals.median(np.arange(1.0, count + 1)).low == rank


def test_the_interquartile_mean_by_hand():
    assert intervals.interquartile_mean(np.arange(1.0, 9.0)[::-1]) == (3 + 4 + 5 + 6) / 4
    assert intervals.interquartile_mean(np.array([3.0, np.inf, 1.0, 2.0])) == 2.5
    assert intervals.interquartile_mean(np.array([3.0, -np.inf, np.inf, 2.0])) == 2.5
    assert np.isposinf(intervals.interquartile_mean(np.array([1.0, np.inf, 2.0, np.inf])))
    both = np.array([-np.inf, -np.inf, np.inf, np.inf])
    assert np.isnan(intervals.interquartile_mean(both))
    rows = np.array([[1.0, 2, 3, 4], [0, 0, 8, 8]])
    assert intervals.interquartile_mean(rows).tolist() == [2.5, 4.0]


def test_log_ratios_of_infinite_scores():
    ratio = intervals.log_ratio(
        np.array([2.0, np.inf, 1.0, np.inf]), np.array([1, 1, np.inf, np.inf])
    )
    assert ratio.tolist() == [np.log(2), np.inf, -np.inf, 0.0]


def test_improvement_counts_ties_half():
    assert intervals.improvement(np.array([-1.0, 0.0, 2.0, np.inf])) == 1.5 / 4


def mean(values):
    return values.mean(axis=-1)


def test_the_bootstrap_of_a_mean_is_the_textbook_one():
    values = np.random.default_rng(1).standard_normal((1, 400))
    found = intervals.bootstrapped([values], mean)
    half = 1.96 * values.std() / 20
    assert found.value == pytest.approx(values.mean())
    assert found.high - found.value == pytest.approx(half, rel=0.12)
    assert found.value - found.low == pytest.approx(half, rel=0.12)


def test_strata_are_kept():
    found = intervals.bootstrapped([np.zeros((1, 30)), np.ones((3, 10))], mean)
    assert (found.value, found.low, found.high) == (0.5, 0.5, 0.5)


def test_training_seeds_are_a_level_of_their_own():
    """Two trainings, one always 0 and one always 1: a replicate has 0, 1 or 2 of each, and episodes
    however many do not narrow that."""
    values = np.repeat([[0.0], [1.0]], 100, axis=1)
    found = intervals.bootstrapped([values], mean)
    assert (found.value, found.low, found.high) == (0.5, 0.0, 1.0)
    # and where trainings agree episodes alone matter: two rows that are the same tell no more
    row = np.random.default_rng(0).standard_normal((1, 50))
    one = intervals.bootstrapped([row], mean)
    two = intervals.bootstrapped([np.repeat(row, 2, axis=0)], mean)
    assert two.high - two.low == pytest.approx(one.high - one.low, rel=0.1)


def test_it_is_reproducible_and_takes_infinite_values():
    values = np.append(np.random.default_rng(0).standard_normal(95), [np.inf] * 5)[None]
    first, second = (
        intervals.bootstrapped([values], intervals.interquartile_mean) for _ in range(2)
    )
    assert first == second
    assert np.isfinite([first.low, first.high]).all()
    assert first.exp.value == np.exp(first.value)
