"""Comparisons of estimates of the same records."""

import numpy as np

from pinnobs_gym.estimation.recursive import RecursiveEstimator

FIELDS = RecursiveEstimator.computes


def assert_near(found, expected, rtol=1e-9):
    """Both have the same NaN pattern, and differ by at most rtol of the field's scale in a row."""
    for name in FIELDS:
        a, b = getattr(found, name), getattr(expected, name)
        if a is None and b is None:
            continue
        assert a.shape == b.shape
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b), err_msg=name)
        size = np.nan_to_num(abs(b), posinf=0.0).max(axis=(0, 1), initial=1e-300)
        scale = np.maximum(size, np.nan_to_num(abs(b)))
        with np.errstate(invalid="ignore"):
            error = abs(a - b) / scale
        assert np.nanmax(np.where(np.isfinite(b), error, 0.0)) <= rtol, name


def assert_same(found, expected):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)
