"""Small matrices of many episodes: the batch comes last, which is several times faster.

Those with `Array` in their annotations take NumPy arrays and torch tensors, which keep gradients.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.system import Array

JITTER = (1e-15, 1e-12, 1e-9, 1e-6)
"""What is added to variances, relatively, until a covariance has a Cholesky factor."""


def sandwich(M: Array, P: Array) -> Array:
    """MPMᵀ for M (n, m, batch) and P (m, m, batch or 1)."""
    if len(M) * len(P) <= 4 and isinstance(
        M, np.ndarray
    ):  # one sum over both indices, which is slower for larger matrices
        return np.einsum("ijb,jkb,lkb->ilb", M, P, M)
    return product(product(M, P), M.swapaxes(0, 1))


def outer(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """ABᵀ, shape (n, k, batch), of (n, m, batch) and (k, m, batch)."""
    return np.einsum("imb,jmb->ijb", A, B)


def divide(A: Array, S: Array) -> Array:
    """AS⁻¹, shape (n, m, batch), for A of that shape and S (m, m, batch), symmetric and positive
    definite; not a number where it is not."""
    if len(S) == 1:
        return A / S
    if not isinstance(S, np.ndarray):
        inverse = array_namespace(S).linalg.inv(S.swapaxes(0, 2))  # of the transposed, batch first
        return product(A, inverse.swapaxes(0, 2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return divide_factored(A, cholesky(S))


def divide_factored(A: np.ndarray, L: np.ndarray) -> np.ndarray:
    """A(LLᵀ)⁻¹, shape (n, m, batch), for A of that shape and L (m, m, batch) lower triangular."""
    m = len(L)
    X = np.empty((*A.shape[:2], max(A.shape[2], L.shape[2])))
    for j in range(m):  # X = A(Lᵀ)⁻¹
        rest = A[:, j] - np.einsum("ikb,kb->ib", X[:, :j], L[j, :j]) if j else A[:, j]
        X[:, j] = rest / L[j, j]
    X[:, -1] /= L[-1, -1]
    for j in reversed(range(m - 1)):  # X L⁻¹
        X[:, j] = (X[:, j] - np.einsum("ikb,kb->ib", X[:, j + 1 :], L[j + 1 :, j])) / L[j, j]
    return X


def cholesky(P: np.ndarray, semidefinite: bool = False) -> np.ndarray:
    """The lower triangular L with LLᵀ = P (n, n, batch); not a number where P is not positive
    definite or, if it may be semidefinite, not a number itself: a pivot below zero is then taken
    for the rounding of zero."""
    L = np.zeros(P.shape)
    for j in range(len(P)):
        column = P[j:, j]
        if j:
            column = column - product(L[j:, :j], L[j, :j, None])[:, 0]
        pivot = np.where(column[0] <= 0, np.inf, column[0]) if semidefinite else column[0]
        L[j:, j] = column / np.sqrt(pivot)
    return L


def factor(P: np.ndarray, jitter: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The Cholesky factors of P (nx, nx, batch), and the larger of the jitter (batch,) so far and
    what had to be added now; not a number where even the largest of `JITTER` does not do."""
    with np.errstate(invalid="ignore", divide="ignore"):
        L = cholesky(P)
        if np.isfinite(L[-1, -1]).all():
            return L, jitter
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
    """The normalised innovation squared (NIS), eᵀS⁻¹e, shape (batch,)."""
    e = innovation.T[None]
    return product(divide(e, S), e.transpose(1, 0, 2))[0, 0]


def product(a: Array, b: Array) -> Array:
    """The matrix products (n, m, batch) of (n, k, batch) and (k, m, batch): several times faster
    than the same with the batch first where the matrices are small."""
    if a.shape[1] == 1:
        return a * b
    if isinstance(a, np.ndarray):
        return np.einsum("ijb,jkb->ikb", a, b)
    return (a[:, :, None] * b[None]).sum(1)


@lru_cache(maxsize=16)
def identity(size: int, batch: int) -> np.ndarray:
    """Identity matrices, shape (size, size, batch), not to be written to."""
    matrix = np.repeat(np.eye(size)[..., None], batch, axis=-1)
    matrix.flags.writeable = False
    return matrix
