"""What filters of the Kalman family share: the prediction and the update in Joseph's form.

Inside these functions the batch comes last, which is several times faster for small matrices.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation.matrices import divide, identity, product, sandwich
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.system import System


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


def observe(
    system: System, t: float, xhat: np.ndarray, y: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Innovations (batch, ny) and output Jacobians (ny, nx, batch), zero where y is missing.

    Args:
        system: the model.
        t: time of the sample in s.
        xhat: predictions, shape (batch, nx).
        y: outputs, shape (batch, ny); NaN is a missing one.
        u: inputs at the sample, shape (batch, nu).
    """
    innovation = y - system.h(t, xhat, u)
    H = system.h_jacobian(t, xhat, u).transpose(1, 2, 0)
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
        innovation: y − h(t, x̂, u), shape (batch, ny).
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
