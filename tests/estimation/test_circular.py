"""Means of points on circles."""

import numpy as np
from angles import TURN
from scipy.stats import circmean

from pinnobs_gym.estimation.circular import gathered

PERIODS = (360.0, None)


def points(num_points=60, batch=4, spread=40.0):
    """Directions about the end of the range, by any number of whole turns."""
    rng = np.random.default_rng(0)
    x = 179 + spread * rng.standard_normal((num_points, batch, 2))
    x[..., 0] += 360 * rng.integers(-3, 4, x.shape[:2])
    return x


def test_points_are_gathered_about_their_circular_mean():
    x = points()
    weights = np.random.default_rng(1).random(x.shape[:2])
    found = gathered(x, PERIODS, weights)
    angle = TURN / 360 * x[..., 0]
    mean = np.angle((weights * np.exp(1j * angle)).sum(axis=0)) * 360 / TURN
    off = found[..., 0] - x[..., 0]
    np.testing.assert_allclose(off / 360, np.round(off / 360), atol=1e-12)
    centre = found[0, :, 0] - (found[0, :, 0] - mean + 180) % 360 + 180  # the mean near them
    assert (abs(found[..., 0] - centre) <= 180 + 1e-9).all()
    np.testing.assert_array_equal(found[..., 1], x[..., 1])


def test_the_mean_of_gathered_points_that_are_near_each_other_is_circular():
    """The two means agree to third order in the spread."""
    x = points(spread=1e-3)
    mean = gathered(x, PERIODS)[..., 0].mean(axis=0)
    expected = circmean(x[..., 0], high=360, axis=0)
    np.testing.assert_allclose(np.cos(TURN / 360 * (mean - expected)), 1.0, atol=1e-14)


def test_a_row_is_gathered_alone_as_in_a_batch():
    x = points()
    together = gathered(x, PERIODS)
    for row in range(x.shape[1]):
        alone = gathered(x[:, row : row + 1], PERIODS)
        np.testing.assert_array_equal(alone[:, 0], together[:, row])


def test_points_that_are_not_finite_do_not_count():
    x = points(num_points=5, batch=1)
    x[0], x[3, 0, 0] = np.nan, np.inf
    found, expected = gathered(x, PERIODS), gathered(x[[1, 2, 4]], PERIODS)
    off = (found[[1, 2, 4], 0, 0] - expected[:, 0, 0]) / 360
    assert len(np.unique(np.round(off, 9))) == 1


def test_without_periods_points_stay_what_they_are():
    x = points()
    assert gathered(x, None) is x
