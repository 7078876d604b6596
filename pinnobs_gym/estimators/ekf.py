"""The extended Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimator import Estimator, State
from pinnobs_gym.record import Prior
from pinnobs_gym.simulate import model_step_jacobian, product
from pinnobs_gym.system import System, vector


@dataclass(frozen=True)
class EKF(Estimator):
    """The continuous-discrete extended Kalman filter (Jazwinski 1970, section 8.3).

    Between samples the state and the variational flow Φ' = A(x̂)Φ by the classical Runge-Kutta
    method, P⁻ = ΦPΦᵀ + Q; at a sample the update in Joseph's form, which keeps P symmetric and
    positive semidefinite. A missing output leaves its part of the update out.

    Default tuning, the same rule for all systems: P₀ from the prior, R from the noise level it is
    told (`Estimator.output_variance`), Q = (`process_noise`·scale)².
    """

    process_noise: float = 1e-4
    """Standard deviation of the process noise per sample, over the state's scale."""

    name = "ekf"

    def __post_init__(self) -> None:
        if not 0 <= self.process_noise < np.inf:
            raise ValueError(f"process_noise={self.process_noise}; expected a number of at least 0")

    def reset(self, prior: Prior) -> State:
        return State(prior.mean, P=prior.cov, memory=self.tuning())

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        Q, R = state.memory
        xhat, P = predicted(self.system, state, t, u, Q)
        innovation, H = innovated(self.system, xhat, y)
        xhat, P, S = joseph_update(xhat, P, innovation, H, R)
        P = ((P + P.transpose(1, 0, 2)) / 2).transpose(2, 0, 1)
        return State(xhat, t, u, P, innovation, S.transpose(2, 0, 1), memory=state.memory)

    def tuning(self) -> tuple[np.ndarray, np.ndarray]:
        """Q (nx, nx, 1) and R (ny, ny, 1), in squared units of state and output."""
        scale = vector(self.system.scale, self.system.nx, "scale")
        Q = np.diag((self.process_noise * scale) ** 2)
        return Q[..., None], np.diag(self.output_variance)[..., None]


def predicted(
    system: System, state: State, t: float, u: np.ndarray, Q: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The prediction x̂(k|k−1), (batch, nx), at time t and its covariance P⁻ = ΦPΦᵀ + Q, (nx, nx,
    batch): here the batch comes last. Before the first sample both are the prior's.

    Args:
        system: the model.
        state: after the sample before.
        t: time of this sample in s.
        u: inputs at this sample, shape (batch, nu).
        Q: covariance of the process noise of a sample, shape (nx, nx, batch or 1).
    """
    xhat, P = state.xhat, _given(state.P).transpose(1, 2, 0)
    if state.t is None:
        return xhat, P
    xhat, F = model_step_jacobian(system, state.t, t, xhat, state.u, u)
    F = F.transpose(1, 2, 0)
    return xhat, product(product(F, P), F.transpose(1, 0, 2)) + Q


def innovated(system: System, xhat: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Innovations y − h(x̂), (batch, ny), and output Jacobians, (ny, nx, batch), of predictions x̂
    (batch, nx) and outputs y (batch, ny); those of missing outputs are zero."""
    missing = np.isnan(y)
    innovation = y - system.h(xhat)
    H = system.h_jacobian(xhat).transpose(1, 2, 0)
    if missing.any():
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
    S = product(HP, H.transpose(1, 0, 2)) + R
    return _divide(HP, S), S


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
    M = -product(K, H)
    for i in range(len(M)):
        M[i, i] += 1
    KR = K * R[0, 0] if len(R) == 1 else np.einsum("ipb,pqc->iqb", K, R)
    P = product(product(M, P), M.transpose(1, 0, 2)) + product(KR, K.transpose(1, 0, 2))
    return xhat + np.einsum("ipb,bp->bi", K, innovation), P


def _divide(HP: np.ndarray, S: np.ndarray) -> np.ndarray:
    """K = PHᵀS⁻¹, (nx, ny, batch); not a number where S is singular."""
    PHt = HP.transpose(1, 0, 2)
    if len(S) == 1:
        return PHt / S
    first = S.transpose(2, 0, 1)
    usable = np.isfinite(first).all(axis=(1, 2)) & (np.linalg.det(first) > 0)
    inverse = np.full_like(first, np.nan)
    inverse[usable] = np.linalg.inv(first[usable])
    return product(PHt, inverse.transpose(1, 2, 0))


def _given(P: np.ndarray | None) -> np.ndarray:
    if P is None:
        raise ValueError("the state has no covariance; begin with reset(prior)")
    return P
