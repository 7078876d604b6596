"""The tests of normalised innovations, and of outliers among them, on values whose law is known."""

import numpy as np
import pytest
from scipy.stats import binomtest, chi2, norm

from pinnobs_gym.logs import innovation_tests
from pinnobs_gym.logs.innovation_tests import (
    correlation_of,
    drift_of,
    effective_number,
    size_of,
)
from pinnobs_gym.logs.input_tests import driven_by
from pinnobs_gym.logs.outlier_tests import outliers_of


def autoregressive(correlation, number, seed=0):
    """Values of variance 1 with autocorrelations ρ, ρ², ..."""
    rng = np.random.default_rng(seed)
    values, noise = np.empty(number), rng.standard_normal(number)
    values[0] = noise[0]
    for k in range(1, number):
        values[k] = correlation * values[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
    return values


@pytest.mark.parametrize("above", [0, 3, 10, 17])
def test_the_chance_of_a_size_is_that_of_the_sign_test(monkeypatch, above):
    monkeypatch.setattr(innovation_tests, "effective_number", lambda values: float(len(values)))
    squares = np.where(np.arange(20) < above, 2.0, 0.5) * chi2.median(3)
    assert size_of(squares, np.full(20, 3)).chance == pytest.approx(binomtest(above, 20).pvalue)


def test_squares_of_several_degrees_are_compared_with_their_own_medians():
    degrees = np.array([1, 2, 5] * 7)
    size = size_of(1.7 * chi2.median(degrees), degrees)
    assert size.median == pytest.approx(1.7)


def test_the_band_of_a_size_holds_that_part_of_medians():
    rng = np.random.default_rng(0)
    squares = rng.chisquare(2, (4000, 51))
    medians = np.median(squares, axis=1) / chi2.median(2)
    bands = [size_of(each, np.full(51, 2)) for each in squares[:300]]
    widest = max(bands, key=lambda band: band.low)  # of independent signs
    inside = ((medians >= widest.low) & (medians <= widest.high)).mean()
    assert inside == pytest.approx(0.95, abs=0.015)


def test_the_effective_number_of_an_autoregressive_process():
    """The variance of its mean is that of n(1 − ρ)/(1 + ρ) independent values."""
    for correlation in (0.3, 0.8):
        expected = 200_000 * (1 - correlation) / (1 + correlation)
        found = effective_number(autoregressive(correlation, 200_000))
        assert found == pytest.approx(expected, rel=0.1)
    white = np.random.default_rng(0).standard_normal(200_000)
    assert effective_number(white) == pytest.approx(200_000, rel=0.02)
    assert effective_number(np.tile([1.0, -1.0], 50)) == 100
    assert effective_number(np.ones(7)) == 7


def test_the_correlation_of_an_autoregressive_process_and_of_white_values():
    t = np.arange(5000.0)
    found = correlation_of(autoregressive(0.6, 5000), t)
    assert found.value == pytest.approx(0.6, abs=0.05)
    assert found.chance < 1e-10
    rng = np.random.default_rng(0)
    white = [correlation_of(rng.standard_normal(400), t[:400]) for _ in range(1000)]
    assert np.mean([abs(each.value) > each.band for each in white]) == pytest.approx(0.05, abs=0.02)
    assert np.mean([each.chance < 0.2 for each in white]) == pytest.approx(0.2, abs=0.04)
    assert white[0].band == pytest.approx(1.96 / np.sqrt(399), rel=1e-3)


def test_values_beyond_a_gap_are_no_neighbours():
    """Groups of four equal values, the next group after a long gap."""
    values = np.repeat(np.random.default_rng(0).standard_normal(100), 4)
    t = np.cumsum(np.tile([5.0, 0.1, 0.1, 0.1], 100))
    found = correlation_of(values, t)
    assert found.value == pytest.approx(1.0)
    assert found.band == pytest.approx(1.96 / np.sqrt(300), rel=1e-3)
    assert correlation_of(values, np.arange(400.0)).value < 0.85


def test_outliers_do_not_hide_a_correlation():
    rng = np.random.default_rng(0)
    values = autoregressive(0.7, 3000)
    values[rng.random(3000) < 0.05] *= 100
    assert correlation_of(values, np.arange(3000.0)).value > 0.5


def test_the_drift_is_the_variance_ratio_of_an_autoregressive_process():
    correlation, values = 0.9, autoregressive(0.9, 400_000)
    found = drift_of(values)
    m = found.length
    lags = np.arange(1, m)
    expected = 1 + 2 * ((1 - lags / m) * correlation**lags).sum()
    assert found.ratio == pytest.approx(expected, rel=0.15)
    assert found.chance < 1e-10


def test_white_values_do_not_drift():
    rng = np.random.default_rng(0)
    chances = [drift_of(rng.standard_normal(1000)).chance for _ in range(1000)]
    assert np.mean(np.array(chances) < 0.05) < 0.08
    assert min(chances) > 1e-5
    assert drift_of(np.zeros(1000)).ratio == 1


def test_single_outliers_and_those_that_come_together():
    rng = np.random.default_rng(0)
    values = rng.standard_normal(2000)
    assert outliers_of(values).share == pytest.approx(0.001, abs=0.0012)
    single = values + 10 * rng.standard_normal(2000) * (rng.random(2000) < 0.05)
    found = outliers_of(single)
    beyond = 0.05 * 2 * norm.sf(norm.isf(0.0005) / np.sqrt(101)) + 0.95 * 0.001
    assert found.share == pytest.approx(beyond, abs=0.012)
    assert found.chance < 1e-10
    assert found.memory < 1.5
    together = np.clip(values, -3, 3)
    together[500:600] += 15
    found = outliers_of(together)
    assert found.memory > 20
    assert (found.first, found.last) == (500, 599)
    none = outliers_of(np.tile([1.0, -1.0], 30))
    assert (none.share, none.chance) == (0, 1)


def test_innovations_that_follow_an_input_are_found():
    rng = np.random.default_rng(0)
    u = np.cumsum(rng.standard_normal((1000, 2)), axis=0)
    white = rng.standard_normal(1000)
    change = np.diff(u[:, 1], prepend=0.0)
    rows = np.arange(1000)
    late = white + 0.75 * np.roll(change, 2)  # a share of 0.36 of the variance
    found = driven_by(late, rows, u, ("a", "b"))
    assert found.input_name == "b"
    assert found.value == pytest.approx(0.6, abs=0.06)
    assert found.chance < 1e-10


def test_independent_inputs_and_those_of_a_controller_are_not_blamed():
    rng = np.random.default_rng(0)
    rows, chances = np.arange(500), []
    for _ in range(300):
        values = rng.standard_normal(500)
        walk = np.cumsum(rng.standard_normal(500))
        fed_back = -2.0 * np.cumsum(values)  # a controller that sums the outputs up to now
        u = np.stack([walk, fed_back], axis=1)
        chances.append(driven_by(values, rows, u, ("walk", "fed back")).chance)
    assert min(chances) > 1e-4
    assert np.mean(np.array(chances) < 0.05) < 0.12


def test_constant_inputs_tell_nothing():
    values = np.random.default_rng(0).standard_normal(200)
    found = driven_by(values, np.arange(200), np.full((200, 1), 3.0), ("a",))
    assert found.chance == 1


def test_echoes_of_an_outlier_are_none_themselves():
    """The innovations of the filter with the constant gain K, whose error a wrong output makes
    −K(1 − K)ʲ times as large as itself: far beyond the others for many samples."""
    rng, K = np.random.default_rng(0), 0.1
    values = rng.standard_normal(2000)
    for k, size in zip(range(50, 2000, 150), 80 * (-1.0) ** np.arange(13), strict=True):
        values[k] += size
        values[k + 1 : k + 100] -= K * size * (1 - K) ** np.arange(99)
    found = outliers_of(values)
    assert found.single == pytest.approx(13 / 2000, rel=0.5)
    assert found.share > 5 * found.single
    assert found.memory < 2
    assert found.largest == pytest.approx(80, abs=4)
