"""Products of matrices large enough for BLAS."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pinnobs_gym.simulation.matrices import divide, outer, product, sandwich

FUNCTIONS = {"product": (product, "ijb,jkb->ikb"), "outer": (outer, "ijb,kjb->ikb")}


@pytest.mark.parametrize(
    ("n", "batch_first"), [(6, False), (8, True), (12, False), (12, True), (40, False), (40, True)]
)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_row_is_the_same_alone_in_any_batch_and_for_any_number_of_threads(n, name, batch_first):
    function, sums = FUNCTIONS[name]
    rng = np.random.default_rng(n)
    a, b = rng.standard_normal((2, n, n, 60))
    if batch_first:
        a, b = (np.ascontiguousarray(part.transpose(2, 0, 1)).transpose(1, 2, 0) for part in (a, b))
    whole = function(a, b)
    np.testing.assert_allclose(whole, np.einsum(sums, a, b), rtol=0, atol=1e-13 * n)
    for size in (1, 7):
        part = function(a[..., :size], b[..., :size])
        np.testing.assert_array_equal(part, whole[..., :size])
    with threadpool_limits(2):
        np.testing.assert_array_equal(function(a, b), whole)


def test_one_matrix_is_multiplied_by_a_batch():
    rng = np.random.default_rng(0)
    M, P = rng.standard_normal((12, 12, 5)), rng.standard_normal((12, 12, 1))
    expected = np.stack([M[..., i] @ P[..., 0] @ M[..., i].T for i in range(5)], axis=-1)
    np.testing.assert_allclose(sandwich(M, P), expected, rtol=1e-12, atol=1e-11)


def banded(rng: np.random.Generator, n: int, batch: int) -> np.ndarray:
    """Return matrices (n, n, batch) of three entries that are not zero in a row, and a last one
    without zeros."""
    i = np.arange(n)[:, None]
    matrices = np.zeros((n, n, batch))
    matrices[i, (i + np.array([0, 1, 5])) % n] = rng.standard_normal((n, 3, batch))
    matrices[..., -1] = rng.standard_normal((n, n))
    return matrices


@pytest.mark.parametrize("batch_first", [False, True])
def test_products_that_leave_zeros_out_are_the_same_in_any_batch(batch_first):
    rng = np.random.default_rng(0)
    M, P = banded(rng, 110, 3), rng.standard_normal((110, 110, 3))
    if batch_first:
        M, P = (np.ascontiguousarray(part.transpose(2, 0, 1)).transpose(1, 2, 0) for part in (M, P))
    calls = {
        "ijb,jkb->ikb": lambda M, P: product(M, P),
        "jkb,ijb->ikb": lambda M, P: product(P, M),
        "ijb,kjb->ikb": lambda M, P: outer(M, P),
        "ijb,jkb,lkb->ilb": lambda M, P: sandwich(M, P),
    }
    for sums, call in calls.items():
        whole = call(M, P)
        parts = (M, P, M) if sums.count(",") == 2 else (M, P)
        expected = np.einsum(sums, *parts, optimize=True)
        np.testing.assert_allclose(whole, expected, rtol=0, atol=1e-9)
        for row in range(3):
            alone = call(M[..., row : row + 1], P[..., row : row + 1])
            np.testing.assert_array_equal(alone[..., 0], whole[..., row])


def test_large_matrices_are_divided_row_by_row():
    rng = np.random.default_rng(0)
    A, B = rng.standard_normal((2, 20, 20, 4))
    S = np.einsum("ijb,kjb->ikb", B, B)
    S[..., 1] = np.nan
    S[..., 2] -= 100 * np.eye(20)  # it has negative eigenvalues
    found = divide(A, S)
    assert np.isnan(found[..., 1:3]).all()
    for row in (0, 3):
        expected = np.linalg.solve(S[..., row], A[..., row].T).T
        np.testing.assert_allclose(found[..., row], expected, rtol=1e-8, atol=1e-8)
        np.testing.assert_array_equal(divide(A[..., [row]], S[..., [row]])[..., 0], found[..., row])
