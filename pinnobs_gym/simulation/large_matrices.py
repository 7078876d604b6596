"""Products and divisions of large matrices, one at a time, so that the result of a row is the same
alone and in any batch.

The Jacobian of a plant with many states has few entries that are not zero in a row, and so has that
of a step. Products with such matrices leave the zeros out: a zero times a number that is not finite
is zero here, and not NaN.
"""

from __future__ import annotations

from copy import copy
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.sparse import csr_array

LARGE = 100
"""Smallest number of rows and columns of matrices that may have many zeros; in smaller ones finding
them takes as long as the product."""
LAPACK = 16
"""Smallest number of rows of matrices that are factored by LAPACK."""
_FILLED = 1 / 12
"""Largest share of entries that are not zero for which a product without them takes less time."""


def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the matrix products (batch, n, m) of (batch or 1, n, k) and (batch or 1, k, m)."""
    if min(*a.shape[1:], b.shape[2]) < LARGE:
        return np.matmul(a, b)
    result = np.empty((max(len(a), len(b)), a.shape[1], b.shape[2]))
    for i in range(len(result)):
        result[i] = _product(a[i % len(a)], b[i % len(b)])
    return result


def sandwiches(M: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return MPMᵀ (batch, n, n) for M (batch, n, m) and P (batch or 1, m, m)."""
    result = np.empty((*M.shape[:2], M.shape[1]))
    for i in range(len(result)):
        own = _without_zeros(M[i]) if _is_sparse(M[i]) else M[i]
        result[i] = (own @ np.ascontiguousarray((own @ P[i % len(P)]).T)).T
    return result


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ab for a (n, k) and b (k, m)."""
    if _is_sparse(a):
        return _without_zeros(a) @ b
    if _is_sparse(b):
        return (_without_zeros(b.T) @ np.ascontiguousarray(a.T)).T
    return a @ b


def _is_sparse(a: np.ndarray) -> bool:
    return bool(np.count_nonzero(a) <= _FILLED * a.size)


def _without_zeros(a: np.ndarray) -> csr_array:
    """Return a matrix (n, k) by its entries that are not zero."""
    n, k = a.shape
    entries = np.ascontiguousarray(a).ravel()
    places = np.flatnonzero(entries != 0)
    made = copy(_empty(n, k))  # SciPy's checks of new ones take as long as a product
    made.data, made.indices = entries[places], places % k
    made.indptr = np.searchsorted(places, np.arange(0, n * k + 1, k))
    return made


@lru_cache(maxsize=16)
def _empty(n: int, k: int) -> csr_array:
    from scipy.sparse import csr_array

    return csr_array((n, k))


def divided(A: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Return A(LLᵀ)⁻¹ (batch, n, m) for A (batch or 1, n, m) and L (batch, m, m), lower
    triangular."""
    half = np.linalg.solve(L, A.swapaxes(1, 2))
    return np.linalg.solve(L.swapaxes(1, 2), half).swapaxes(1, 2)


def factors(S: np.ndarray) -> np.ndarray:
    """Return the lower triangular L with LLᵀ = S (batch, n, n), NaN where S has none."""
    try:
        return np.linalg.cholesky(S)
    except np.linalg.LinAlgError:
        if len(S) == 1:
            return np.full(S.shape, np.nan)
        return np.concatenate([factors(each[None]) for each in S])
