"""Operations on batches of small matrices. The batch is the last axis, which is several times
faster.

Sums are formed in the order of the index, in batches of any size, so that the result of a row is
the same to the last bit alone and in any batch. `numpy.einsum` does so in batches of several rows,
where its innermost loop is over the batch. In a batch of one row its innermost loop may be over the
index of the sum, which is then split into parts. Large products are formed by BLAS, which chooses
the order by the shape, one matrix at a time.

Functions annotated with `Array` take NumPy arrays and torch tensors, and preserve gradients.
"""

from __future__ import annotations

import inspect
import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.large_matrices import (
    LAPACK,
    LARGE,
    divided,
    factors,
    products,
    sandwiches,
)

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import Array

einsum = inspect.unwrap(np.einsum)
"""`numpy.einsum` for NumPy arrays alone: without its dispatch to other libraries, which takes a
third of the time of a product of small matrices."""

BLAS = 8
"""Number of rows or columns of a product from which it is formed by BLAS, which takes less time."""
JITTER = (1e-15, 1e-12, 1e-9, 1e-6)
"""Relative amounts added to the variances, in turn, until a covariance has a Cholesky factor."""


def sandwich(M: Array, P: Array) -> Array:
    """Return MPMᵀ for M (n, m, batch) and P (m, m, batch or 1)."""
    if not isinstance(M, np.ndarray):
        return product(product(M, P), M.swapaxes(0, 1))
    if min(M.shape[:2]) >= LARGE and M.shape[2] >= P.shape[2]:
        first, second = (np.ascontiguousarray(part.transpose(2, 0, 1)) for part in (M, P))
        return sandwiches(first, second).transpose(1, 2, 0)
    if len(M) * len(P) > 4:
        return product(product(M, P), M.swapaxes(0, 1))
    # A single sum over both indices is faster for the smallest matrices only.
    if M.shape[-1] > 1:
        return einsum("ijb,jkb,lkb->ilb", M, P, M)
    if len(M) > 1:  # the innermost loop is over l if M is transposed in memory
        return einsum("ijb,jkb,klb->ilb", M, P, np.ascontiguousarray(M.swapaxes(0, 1)))
    terms = (M.swapaxes(0, 1) * P * M).reshape(1, -1, P.shape[-1])
    return np.add.accumulate(terms, axis=1)[:, -1:]


def outer(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Return ABᵀ, shape (n, k, batch), for A (n, m, batch) and B (k, m, batch)."""
    if max(len(A), len(B)) >= BLAS:
        return _by_blas(A, B.swapaxes(0, 1))
    if A.shape[-1] > 1:
        return einsum("imb,jmb->ijb", A, B)
    return np.add.accumulate(A[:, None] * B, axis=2)[:, :, -1]


def divide(A: Array, S: Array) -> Array:
    """Return AS⁻¹, shape (n, m, batch), for A of that shape and S (m, m, batch), symmetric and
    positive definite.

    In NumPy, where rounding leaves S no Cholesky factor, as for two equal sensors and P much larger
    than R, the result is that of the pseudoinverse; it is NaN where S is zero, not finite, or has a
    negative eigenvalue that is no rounding error.
    """
    if len(S) == 1:
        return A / S
    if not isinstance(S, np.ndarray):
        inverse = array_namespace(S).linalg.inv(S.swapaxes(0, 2))  # batch first; S is symmetric
        return product(A, inverse.swapaxes(0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        if len(S) >= LAPACK:
            X, last = _by_lapack(A, S)
        else:
            L = cholesky(S)
            X, last = divide_factored(A, L), L[-1, -1]
    # A pivot that is not positive makes this one NaN: the sum tells whether there is any.
    if not math.isfinite(last.sum()):
        rows = np.flatnonzero(~np.isfinite(last) & np.isfinite(S).all(axis=(0, 1)))
        if len(rows):
            X[..., rows] = _by_eigenvalues(A[..., rows if A.shape[2] > 1 else [0]], S[..., rows])
    return X


def _by_lapack(A: np.ndarray, S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return AS⁻¹ (n, m, batch) and the last pivots of the factors of S, (batch,), NaN where S has
    none."""
    L = factors(np.ascontiguousarray(S.transpose(2, 0, 1)))
    X = divided(np.ascontiguousarray(A.transpose(2, 0, 1)), L)
    return X.transpose(1, 2, 0), L[:, -1, -1]


def _by_eigenvalues(A: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return AS⁺ (n, m, batch) with the pseudoinverse of S (m, m, batch), for which eigenvalues
    within the rounding error of the largest are zero; NaN where S is zero or has a negative one
    beyond it."""
    values, vectors = np.linalg.eigh(S.transpose(2, 0, 1))
    largest = values[:, -1:]
    rounding = 1e-14 * len(S) * largest
    kept = values > rounding
    inverse = np.where(kept, 1 / np.where(kept, values, 1.0), 0.0)
    inverse = np.where((largest > 0) & (values[:, :1] >= -rounding), inverse, np.nan)
    parts = (A.transpose(2, 0, 1) @ vectors) * inverse[:, None]
    return (parts @ vectors.swapaxes(1, 2)).transpose(1, 2, 0)


def divide_factored(A: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Return A(LLᵀ)⁻¹, shape (n, m, batch), for A of that shape and L (m, m, batch) lower
    triangular."""
    m = len(L)
    X = np.empty((*A.shape[:2], max(A.shape[2], L.shape[2])))
    for j in range(m):  # forward substitution: X = A(Lᵀ)⁻¹
        rest = A[:, j] - product(X[:, :j], L[j, :j, None])[:, 0] if j else A[:, j]
        X[:, j] = rest / L[j, j]
    X[:, -1] /= L[-1, -1]
    for j in reversed(range(m - 1)):  # back substitution: X becomes XL⁻¹
        X[:, j] = (X[:, j] - product(X[:, j + 1 :], L[j + 1 :, j, None])[:, 0]) / L[j, j]
    return X


def cholesky(P: np.ndarray, semidefinite: bool = False) -> np.ndarray:
    """Return the lower triangular L with LLᵀ = P (n, n, batch).

    L is NaN where P is not positive definite. If ``semidefinite`` is true, a pivot at or below zero
    counts as a zero with rounding error and its column is zero; L is then NaN only where P is.
    """
    L = np.zeros(P.shape)
    for j in range(len(P)):
        column = P[j:, j]
        if j:
            # Subtract the contribution of the columns already factored.
            column = column - product(L[j:, :j], L[j, :j, None])[:, 0]
        pivot = np.where(column[0] <= 0, np.inf, column[0]) if semidefinite else column[0]
        L[j:, j] = column / np.sqrt(pivot)
    return L


def factor(P: np.ndarray, jitter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Cholesky factors of P (nx, nx, batch), and the larger of ``jitter`` (batch,) and
    the relative amount that had to be added now. Factors are NaN where even the largest `JITTER`
    fails."""
    with np.errstate(invalid="ignore", divide="ignore"):
        L = cholesky(P)
        if np.isfinite(L[-1, -1]).all():
            return L, jitter
        # Enlarge the variances of those matrices alone that have no factor yet, more each time.
        for added in JITTER:
            bad = ~np.isfinite(L).all(axis=(0, 1)) & np.isfinite(P).all(axis=(0, 1))
            if not bad.any():
                break
            enlarged = P[..., bad]
            for i in range(len(P)):
                enlarged[i, i] += added * enlarged[i, i] + np.finfo(float).tiny
            L[..., bad] = cholesky(enlarged)
            jitter = np.where(bad, np.maximum(jitter, added), jitter)
    return L, jitter


def squared_size(innovation: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return the normalised innovation squared (NIS), eᵀS⁻¹e, shape (batch,), for innovations e
    (batch, ny) and their covariances S (ny, ny, batch)."""
    e = np.ascontiguousarray(innovation.T)
    return inner(divide(e[None], S)[0], e)


def product(a: Array, b: Array) -> Array:
    """Return the matrix products (n, m, batch) of (n, k, batch) and (k, m, batch). For small
    matrices this is several times faster than with the batch first."""
    rows, terms, batch = a.shape
    if terms == 1:
        return a * b
    if not isinstance(a, np.ndarray):
        return (a[:, :, None] * b[None]).sum(1)
    if max(rows, b.shape[1]) >= BLAS:
        return _by_blas(a, b)
    if batch > 1 or terms == 2:
        return einsum("ijb,jkb->ikb", a, b)
    if b.shape[1] == 1:
        return np.add.accumulate(a * b[:, 0], axis=1)[:, -1:]
    # With rows of b contiguous in memory, the innermost loop is over k.
    return einsum("ijb,jkb->ikb", a, np.ascontiguousarray(b))


def _by_blas(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products (n, m, batch) of `product` by BLAS. Each is formed by itself from
    contiguous matrices, so that it does not depend on the others.

    The batch is first in the memory of large results, so that further products need no copy. It is
    last in that of small ones: `numpy.einsum`, which may use them, sums in order only then.
    """
    first, second = (np.ascontiguousarray(part.transpose(2, 0, 1)) for part in (a, b))
    result = products(first, second).transpose(1, 2, 0)
    return result if min(result.shape[:2]) >= BLAS else np.ascontiguousarray(result)


def mapped(M: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the vectors Mv, shape (batch, n), for M (n, m, batch) and v (batch, m)."""
    column = v.T if len(v.T) <= 2 else np.ascontiguousarray(v.T)
    return product(M, column[:, None])[:, 0].T


def inner(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the inner products aᵀb, shape (batch,), of vectors (n, batch)."""
    return product(a[None], b[:, None])[0, 0]


def spread(L: np.ndarray, draws: np.ndarray) -> np.ndarray:
    """Return Lξ for each of the vectors ξ of ``draws`` (num_points, m), shape (num_points, batch,
    n), for L (n, m, batch)."""
    columns = np.ascontiguousarray(L.transpose(1, 2, 0))
    return einsum("jbi,mj->mbi", columns, draws)


def total(x: np.ndarray) -> np.ndarray:
    """Return the sum of x (num_points, batch, ...) over the points."""
    return x.sum(axis=0) if x[0].size > 1 else np.add.accumulate(x, axis=0)[-1]


def moments(weights: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weighted means (batch, n) and covariances (batch, n, n) of points x (num_points,
    batch, n) with weights (num_points, batch), which sum to one. Here the batch is first."""
    mean = weighted_mean(weights, x)
    deviations = (x - mean).transpose(2, 0, 1)
    if x[0].size > 1:
        return mean, einsum("imb,jmb->bij", weights * deviations, deviations)
    return mean, outer(weights * deviations, deviations)


def weighted_mean(weights: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the weighted means (batch, n) of points x (num_points, batch, n) with weights
    (num_points, batch), which sum to one."""
    if x[0].size > 1:
        return einsum("mb,mbi->bi", weights, x)
    return total(weights[..., None] * x)


@lru_cache(maxsize=16)
def identity(size: int, batch: int) -> np.ndarray:
    """Return read-only identity matrices, shape (size, size, batch)."""
    if size >= BLAS:  # the memory of one
        return np.broadcast_to(np.eye(size)[..., None], (size, size, batch))
    matrix = np.repeat(np.eye(size)[..., None], batch, axis=-1)
    matrix.flags.writeable = False
    return matrix
