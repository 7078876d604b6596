"""Operations on batches of small matrices, against sums formed one product after the other."""

import numpy as np
import pytest

from pinnobs_gym.simulation import matrices

SIZES = [(1, 2, 2), (2, 2, 2), (3, 3, 3), (1, 3, 1), (5, 5, 1), (3, 9, 2), (1, 12, 1)]


def in_order(terms):
    result = terms[0]
    for term in terms[1:]:
        result = result + term
    return result


def drawn(rng, n, m, batch, transposed):
    if transposed:
        return rng.standard_normal((m, n, batch)).swapaxes(0, 1)
    return rng.standard_normal((n, m, batch))


@pytest.mark.parametrize("batch", [1, 2, 7])
@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize(("n", "k", "m"), SIZES)
def test_sums_are_formed_in_order_in_any_batch(n, k, m, transposed, batch):
    rng = np.random.default_rng(0)
    for _ in range(20):
        A, B = drawn(rng, n, k, batch, transposed), drawn(rng, k, m, batch, transposed)
        v = rng.standard_normal((batch, k))
        expected = in_order([A[:, j, None] * B[j] for j in range(k)])
        np.testing.assert_array_equal(matrices.product(A, B), expected)
        expected = in_order([A[:, None, j] * A[None, :, j] for j in range(k)])
        np.testing.assert_array_equal(matrices.outer(A, A), expected)
        expected = in_order([A[:, j] * v[:, j] for j in range(k)])
        np.testing.assert_array_equal(matrices.mapped(A, v), expected.T)
        expected = in_order([A[0, j] * B[j, 0] for j in range(k)])
        np.testing.assert_array_equal(matrices.inner(A[0], B[:, 0]), expected)


@pytest.mark.parametrize(("n", "m"), [(1, 2), (1, 3), (2, 2), (3, 3), (5, 5)])
def test_the_sandwich_of_a_row_is_that_of_the_batch(n, m):
    rng = np.random.default_rng(0)
    for _ in range(20):
        M, P = rng.standard_normal((n, m, 7)), rng.standard_normal((m, m, 7))
        P = P + P.swapaxes(0, 1)
        together = matrices.sandwich(M, P)
        np.testing.assert_allclose(together, np.einsum("ija,jka,lka->ila", M, P, M), atol=1e-9)
        for i in range(7):
            row = matrices.sandwich(M[..., i : i + 1].copy(), P[..., i : i + 1].copy())
            np.testing.assert_array_equal(row[..., 0], together[..., i])


@pytest.mark.parametrize("n", [1, 2, 3])
def test_moments_of_a_row_are_those_of_the_batch(n):
    rng = np.random.default_rng(0)
    weights, x = rng.random((50, 7)), rng.standard_normal((50, 7, n))
    weights /= weights.sum(axis=0)
    L, draws = rng.standard_normal((n, n, 7)), rng.standard_normal((50, n))
    means, covariances = matrices.moments(weights, x)
    spread, totals = matrices.spread(L, draws), matrices.total(x)
    np.testing.assert_allclose(spread[:, 3], draws @ L[..., 3].T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(means[3], weights[:, 3] @ x[:, 3], rtol=1e-9, atol=1e-12)
    for i in range(7):
        row = slice(i, i + 1)
        mean, covariance = matrices.moments(weights[:, row].copy(), x[:, row].copy())
        np.testing.assert_array_equal(mean[0], means[i])
        np.testing.assert_array_equal(covariance[0], covariances[i])
        np.testing.assert_array_equal(matrices.total(x[:, row].copy())[0], totals[i])
        one = matrices.spread(L[..., row].copy(), draws)
        np.testing.assert_array_equal(one[:, 0], spread[:, i])
