"""Products of matrices large enough for BLAS."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from pinnobs_gym.simulation.matrices import outer, product, sandwich

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
