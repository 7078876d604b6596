"""What estimators with a mean and a covariance share: tuning, checks, the prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator, Range, State
from pinnobs_gym.estimation.kalman import predict
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System, vector


@dataclass(frozen=True)
class GaussianEstimator(BaseEstimator):
    """The settings of estimators that carry a mean and a covariance.

    The same rule for all systems: x̂₀ and P₀ from the prior, R diagonal from the noise level they
    are given (`BaseEstimator.output_variance`), Q = diag(`process_noise`·scale)² per sample.
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


def predicted(
    system: System, state: State, P: np.ndarray, Q: np.ndarray, t: float, u: np.ndarray
) -> State:
    """The prediction x̂(k|k−1) at time t (s), and its covariance ΦPΦᵀ + Q, of a state after a
    sample; see `RecursiveEstimator.predict`.

    Args:
        system: the model.
        state: after the sample before.
        P: the covariances that are predicted, shape (nx, nx, batch).
        Q: covariance of the process noise of a sample, shape (nx, nx, batch or 1).
        t: time of the next sample in s.
        u: inputs at the next sample, shape (batch, nu).
    """
    assert state.t is not None  # before the first sample nothing is predicted
    xhat, P, _ = predict(system, (state.t, t), state.xhat, P, Q, (state.u, u))
    covariance = P.transpose(2, 0, 1)
    return State(xhat, state.t, state.u, covariance, state.innovation, None, state.memory)
