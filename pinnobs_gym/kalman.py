"""What filters of the Kalman family share: tuning, prediction, and the update in Joseph's form.

Inside these functions the batch comes last, which is several times faster for small matrices.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimator import Estimator, Range, State
from pinnobs_gym.record import Prior
from pinnobs_gym.simulate import identity, model_step_jacobian, product
from pinnobs_gym.system import System, vector

JITTER = (1e-15, 1e-12, 1e-9, 1e-6)
"""What is added to variances, relatively, until a covariance has a Cholesky factor."""


@dataclass(frozen=True)
class GaussianEstimator(Estimator):
    """What estimators that carry a mean and a covariance are told.

    The same rule for all systems: x̂₀ and P₀ from the prior, R diagonal from the noise level they
    are told (`Estimator.output_variance`), Q = diag(`process_noise`·scale)² per sample.
    """

    process_noise: float = 1e-4
    """Standard deviation of the process noise per sample, over the state's scale."""

    tunable = {"process_noise": Range(1e-7, 1e-1, log=True)}

    def __post_init__(self) -> None:
        if not 0 <= self.process_noise < np.inf:
            raise ValueError(f"process_noise={self.process_noise}; expected a number of at least 0")

    def tuning(self, batch: int = 1) -> tuple[np.ndarray, np.ndarray]:
        """Q (nx, nx, batch) and R (ny, ny, batch), the same for all rows."""
        scale = vector(self.system.scale, self.system.nx, "scale")
        Q = np.diag((self.process_noise * scale) ** 2)
        R = np.diag(self.output_variance)
        return np.repeat(Q[..., None], batch, axis=-1), np.repeat(R[..., None], batch, axis=-1)


def checked(prior: Prior) -> Prior:
    """The prior in double precision, if its covariances are such.

    Raises:
        ValueError: in one line, if one is not symmetric and positive semidefinite.
    """
    P = np.asarray(prior.cov, dtype=float)
    size = abs(P).max(axis=(1, 2))
    if (
        not np.isfinite(P).all()
        or (abs(P - P.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-9 * size).any()
    ):
        raise ValueError("P0 is not symmetric and finite; expected a covariance")
    least = np.linalg.eigvalsh(P)[:, 0]
    if (least < -1e-9 * size).any():
        row = int(np.argmin(least / np.maximum(size, 1e-300)))
        raise ValueError(
            f"P0 of row {row} has eigenvalue {least[row]:.3g}; expected a covariance, none below 0"
        )
    return Prior(np.asarray(prior.mean, dtype=float), P)


def covariances(state: State) -> np.ndarray:
    """The covariances of a state, shape (nx, nx, batch)."""
    if state.P is None:
        raise ValueError("the state has no covariance; begin with reset(prior)")
    return state.P.transpose(1, 2, 0)


def predict(
    system: System,
    times: tuple[float, float],
    xhat: np.ndarray,
    P: np.ndarray,
    Q: np.ndarray,
    inputs: tuple[np.ndarray | None, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The estimates and covariances at the later of two times, ΦPΦᵀ + Q, and the flow Φ.

    Args:
        system: the model.
        times: of the sample before and of this one, in s.
        xhat: estimates at the earlier, shape (batch, nx).
        P: their covariances, shape (nx, nx, batch).
        Q: covariance of the process noise, shape (nx, nx, batch or 1).
        inputs: at the two times, shape (batch, nu).
    """
    xhat, F = model_step_jacobian(system, *times, xhat, *inputs)
    F = F.transpose(1, 2, 0)
    P = sandwich(F, P)
    P += Q
    return xhat, P, F


def predicted(
    system: System, state: State, t: float, u: np.ndarray, Q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The prediction x̂(k|k−1), (batch, nx), at time t (s) and its covariance P⁻, (nx, nx, batch).

    Before the first sample both are the prior's.

    Args:
        system: the model.
        state: after the sample before.
        t: time of this sample in s.
        u: inputs at this sample, shape (batch, nu).
        Q: covariance of the process noise of a sample, shape (nx, nx, batch or 1).
    """
    xhat, P = state.xhat, covariances(state)
    if state.t is not None:
        xhat, P, _ = predict(system, (state.t, t), xhat, P, Q, (state.u, u))
    return xhat, P


def observe(system: System, xhat: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Innovations (batch, ny) and output Jacobians (ny, nx, batch), zero where y is missing."""
    innovation = y - system.h(xhat)
    H = system.h_jacobian(xhat).transpose(1, 2, 0)
    missing = np.isnan(y)
    if np.count_nonzero(missing):  # several times faster than any() on few numbers
        innovation = np.where(missing, 0.0, innovation)
        H = np.where(missing.T[:, None], 0.0, H)
    return innovation, H


def joseph_update(
    xhat: np.ndarray, P: np.ndarray, innovation: np.ndarray, H: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The Kalman update of a batch in Joseph's form.

    Args:
        xhat: predictions, shape (batch, nx).
        P: their covariances, shape (nx, nx, batch): here the batch comes last.
        innovation: y − h(x̂), shape (batch, ny).
        H: output Jacobians, shape (ny, nx, batch).
        R: covariance of the output noise, shape (ny, ny, batch or 1).

    Returns:
        Estimates (batch, nx), their covariances (nx, nx, batch), and those of the innovations
        (ny, ny, batch).
    """
    K, S = kalman_gain(P, H, R)
    return *update_with(K, xhat, P, innovation, H, R), S


def kalman_gain(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The gains K = PHᵀS⁻¹, (nx, ny, batch), and the covariances S = HPHᵀ + R of the innovations,
    (ny, ny, batch); arguments as in `joseph_update`."""
    HP = product(H, P)
    S = product(HP, H.transpose(1, 0, 2))
    S += R
    return divide(HP.transpose(1, 0, 2), S), S


def update_with(
    K: np.ndarray,
    xhat: np.ndarray,
    P: np.ndarray,
    innovation: np.ndarray,
    H: np.ndarray,
    R: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimates (batch, nx) and their covariances (nx, nx, batch) after an update with any gains K
    (nx, ny, batch): P⁺ = (I − KH)P(I − KH)ᵀ + KRKᵀ; other arguments as in `joseph_update`."""
    M = identity(len(P), P.shape[-1]) - product(K, H)
    P = sandwich(M, P)
    P += sandwich(K, R)
    P = P + P.transpose(1, 0, 2)  # which rounding alone leaves asymmetric
    P *= 0.5
    x = xhat.T + product(K, innovation.T[:, None])[:, 0]
    return x.T, P


def sandwich(M: np.ndarray, P: np.ndarray) -> np.ndarray:
    """MPMᵀ for M (n, m, batch) and P (m, m, batch or 1)."""
    if len(M) * len(P) <= 4:  # one sum over both indices, which is slower for larger matrices
        return np.einsum("ijb,jkb,lkb->ilb", M, P, M)
    return product(product(M, P), M.transpose(1, 0, 2))


def outer(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """ABᵀ, shape (n, k, batch), of (n, m, batch) and (k, m, batch)."""
    return np.einsum("imb,jmb->ijb", A, B)


def divide(A: np.ndarray, S: np.ndarray) -> np.ndarray:
    """AS⁻¹, shape (n, m, batch), for A of that shape and S (m, m, batch), symmetric and positive
    definite; not a number where it is not."""
    if len(S) == 1:
        return A / S
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
