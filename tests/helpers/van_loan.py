"""The covariance of process noise over a step, from a matrix exponential."""

import numpy as np
from scipy.linalg import expm


def noise_covariance(A, L, dt):
    """Q = ∫e^{As}LLᵀe^{Aᵀs}ds from 0 to dt, for dx = Ax dt + L dw (Van Loan 1978)."""
    n, L = len(A), np.asarray(L)
    blocks = expm(dt * np.block([[-np.asarray(A), L @ L.T], [np.zeros((n, n)), np.asarray(A).T]]))
    return blocks[n:, n:].T @ blocks[:n, n:]
