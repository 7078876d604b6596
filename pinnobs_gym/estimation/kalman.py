"""What filters of the Kalman family share: the prediction and the update in Joseph's form.

Inside these functions the batch comes last, which is several times faster for small matrices. Those
with `Array` in their annotations take NumPy arrays and torch tensors, which keep gradients.
"""

from __future__ import annotations

import numpy as np
from array_api_compat import array_namespace

from pinnobs_gym.simulation.matrices import divide, identity, outer, product, sandwich
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.system import Array, System


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
    xhat: Array, P: Array, innovation: Array, H: Array, R: Array
) -> tuple[Array, Array, Array]:
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


def kalman_gain(P: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """The gains K = PHᵀS⁻¹, (nx, ny, batch), and the covariances S = HPHᵀ + R of the innovations,
    (ny, ny, batch); arguments as in `joseph_update`."""
    HP = product(H, P)
    S = product(HP, H.swapaxes(0, 1))
    S += R
    return divide(HP.swapaxes(0, 1), S), S


def gain_of_deviations(
    X: np.ndarray, Y: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The gains K = XYᵀS⁻¹, (nx, ny, batch), and the covariances S = YYᵀ + R of the innovations,
    (ny, ny, batch), from points about the estimate.

    Args:
        X: weighted deviations of the points, shape (nx, num_points, batch).
        Y: those of their outputs, shape (ny, num_points, batch); zero where y is missing.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
    """
    S = outer(Y, Y)
    S += R
    return divide(outer(X, Y), S), S


def update_with(
    K: Array, xhat: Array, P: Array, innovation: Array, H: Array, R: Array
) -> tuple[Array, Array]:
    """Estimates (batch, nx) and their covariances (nx, nx, batch) after an update with any gains K
    (nx, ny, batch): P⁺ = (I − KH)P(I − KH)ᵀ + KRKᵀ; other arguments as in `joseph_update`."""
    if isinstance(P, np.ndarray):
        M = identity(len(P), P.shape[-1]) - product(K, H)
    else:
        M = array_namespace(P).eye(len(P), dtype=P.dtype)[..., None] - product(K, H)
    P = sandwich(M, P)
    P += sandwich(K, R)
    P = P + P.swapaxes(0, 1)  # which rounding alone leaves asymmetric
    P *= 0.5
    x = xhat.T + product(K, innovation.T[:, None])[:, 0]
    return x.T, P
