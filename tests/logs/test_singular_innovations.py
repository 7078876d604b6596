"""Covariances of innovations that are singular, as where a filter has lost the state."""

import numpy as np

from pinnobs_gym.logs.normalised import _normalised_squares


def test_singular_covariances_have_no_normalised_square_and_raise_nothing():
    rng, count = np.random.default_rng(0), 500
    root = rng.standard_normal((2 * count, 6, 6))
    root[count:, :, 3:] = 0  # of rank three
    S = np.einsum("kij,klj->kil", root, root)
    std = np.sqrt(np.einsum("kii->ki", S))
    values = rng.standard_normal((2 * count, 6))
    squares = _normalised_squares(values, S, np.zeros(values.shape, dtype=bool))
    correlations = S[:count] / std[:count, :, None] / std[:count, None, :]
    expected = [v @ np.linalg.inv(C) @ v for v, C in zip(values[:count], correlations, strict=True)]
    np.testing.assert_allclose(squares[:count], expected, rtol=1e-6)
    assert np.isnan(squares[count:]).all()
