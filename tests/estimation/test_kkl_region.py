"""The region in which a KKL observer was trained, and what is outside of it."""

import numpy as np
from scipy.spatial.distance import cdist

from pinnobs_gym.estimation.learned.kkl_region import POINTS, Region


def pairs(count=4000):
    """z on a curved surface of three dimensions, and two states, of unlike sizes."""
    x = np.random.default_rng(0).uniform(-1, 1, (count, 2)) * (1.0, 50.0)
    z = np.stack([x[:, 0], x[:, 1] / 50, x[:, 0] ** 3 - x[:, 1] / 50], axis=1)
    return 1e-3 * z, x


def test_all_pairs_of_the_training_are_inside():
    z, x = pairs()
    region = Region.of(z, x, seed=0)
    assert not region.outside(z, x).any()
    assert region.points.shape == (POINTS, 5)


def test_the_region_is_what_is_near_a_pair_of_the_training():
    """With distances by another library."""
    z, x = pairs()
    region = Region.of(z, x, seed=0)
    rng = np.random.default_rng(1)
    tried_z, tried_x = (a[:500] + a.std(0) * rng.normal(0, 0.15, a[:500].shape) for a in (z, x))
    whole = np.concatenate([z, x], axis=1)
    mean, std = whole.mean(0), whole.std(0)
    scaled = (np.concatenate([tried_z, tried_x], axis=1) - mean) / std
    nearest = cdist(scaled, region.points).min(axis=1)
    np.testing.assert_array_equal(region.outside(tried_z, tried_x), nearest > region.radius)
    assert 0.2 < (nearest > region.radius).mean() < 0.9
    # The points are pairs of the training, and cover them.
    assert cdist(region.points, (whole - mean) / std).min(axis=1).max() < 1e-12
    covered = cdist((whole - mean) / std, region.points).min(axis=1).max()
    np.testing.assert_allclose(region.radius, covered, rtol=1e-9)


def test_what_is_far_away_or_not_finite_is_outside():
    z, x = pairs(50)
    region = Region.of(z, x, seed=0)
    assert len(region.points) == 50
    for factor in (10.0, np.nan, np.inf):
        with np.errstate(invalid="ignore"):
            assert region.outside(factor * (z[:1] + 1), x[:1]).all()
            assert region.outside(z[:1], factor * (x[:1] + 100)).all()


def test_a_component_that_is_constant_has_no_scale():
    z, x = pairs(50)
    region = Region.of(np.concatenate([z, np.full((50, 1), 3.0)], axis=1), x, seed=0)
    assert region.scale[3] == 1.0
    assert np.isfinite(region.radius)
