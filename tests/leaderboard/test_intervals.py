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
