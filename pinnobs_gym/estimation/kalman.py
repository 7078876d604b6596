"""The prediction and the update in Joseph's form, shared by filters of the Kalman family.

Matrices have the batch as their last axis, which is several times faster for small matrices.
Functions annotated with `Array` take NumPy arrays and torch tensors, and preserve gradients.
"""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.matrices import divide, identity, mapped, outer, product, sandwich
from pinnobs_gym.simulation.model import model_step_moments
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import Array, System
from pinnobs_gym.simulation.value_shape import outputs_at


def predict(
    system: System,
    times: tuple[float, float],
    xhat: np.ndarray,
    P: np.ndarray,
    noise: Noise,
    inputs: tuple[np.ndarray | None, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Predict estimates and covariances from one sample to the next.

    Args:
        system: the model.
        times: times of the two samples in s.
        xhat: estimates at the first, shape (batch, nx).
        P: their covariances, shape (nx, nx, batch).
        noise: the noise, of which the process noise is used.
        inputs: inputs at the two samples, shape (batch, nu).

    Returns:
        Predictions (batch, nx), their covariances ΦPΦᵀ + Q (nx, nx, batch), the Jacobian Φ of the
        model's step (nx, nx, batch), and Q (nx, nx, batch or 1).
    """
    xhat, F, Q = model_step_moments(system, noise, *times, xhat, *inputs)
    P = sandwich(F, P)
    P += Q
    return xhat, P, F, Q


def observe(
    system: System, t: float, xhat: np.ndarray, y: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return innovations (batch, ny) and output Jacobians (ny, nx, batch), zero where y is missing.

    Args:
        system: the model.
        t: time of the sample in s.
        xhat: predictions, shape (batch, nx).
        y: outputs, shape (batch, ny); NaN marks a missing output.
        u: inputs at the sample, shape (batch, nu).
    """
    yhat = outputs_at(system, t, xhat, u)
    innovation = system.output_residual(y, yhat)
    H = system.h_jacobian(t, xhat, u).transpose(1, 2, 0)
    missing = np.isnan(y)
    if np.count_nonzero(missing):  # several times faster than any() for small arrays
        innovation = np.where(missing, 0.0, innovation)
        H = np.where(missing.T[:, None], 0.0, H)
    return innovation, H


def joseph_update(
    xhat: Array, P: Array, innovation: Array, H: Array, R: Array
) -> tuple[Array, Array, Array]:
    """Apply the Kalman update in Joseph's form to a batch.

    Args:
        xhat: predictions, shape (batch, nx).
        P: their covariances, shape (nx, nx, batch).
        innovation: y − h(t, x̂, u), shape (batch, ny).
        H: output Jacobians, shape (ny, nx, batch).
        R: covariance of the output noise, shape (ny, ny, batch or 1).

    Returns:
        Estimates (batch, nx), their covariances (nx, nx, batch), and the covariances of the
        innovations (ny, ny, batch).
    """
    K, S = kalman_gain(P, H, R)
    return *update_with(K, xhat, P, innovation, H, R), S


def kalman_gain(P: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """Return the gains K = PHᵀS⁻¹ (nx, ny, batch) and the innovation covariances S = HPHᵀ + R
    (ny, ny, batch). The arguments are those of `joseph_update`."""
    HP = product(H, P)
    S = product(HP, H.swapaxes(0, 1))
    S += R
    return divide(HP.swapaxes(0, 1), S), S


def innovation_covariance(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return S = HPHᵀ + R, shape (ny, ny, batch); the arguments are those of `joseph_update`."""
    return sandwich(H, P) + R


def cautious(P: np.ndarray, H: np.ndarray, R: np.ndarray, fraction: float) -> np.ndarray:
    """Return R with a fraction of HPHᵀ added, (ny, ny, batch or 1), which shortens an update
    (Boutayeb & Aubry 1999); the other arguments are those of `joseph_update`."""
    return R + fraction * sandwich(H, P) if fraction else R


def gain_of_deviations(
    X: np.ndarray, Y: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the gains K = XYᵀS⁻¹ (nx, ny, batch) and the innovation covariances S = YYᵀ + R
    (ny, ny, batch), computed from sigma points or an ensemble.

    Args:
        X: deviations of the points from their mean, times the square roots of their weights, shape
            (nx, num_points, batch).
        Y: the same for their outputs, shape (ny, num_points, batch); zero where y is missing.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
    """
    S = outer(Y, Y)
    S += R
    return divide(outer(X, Y), S), S


def update_with(
    K: Array, xhat: Array, P: Array, innovation: Array, H: Array, R: Array
) -> tuple[Array, Array]:
    """Return estimates (batch, nx) and their covariances (nx, nx, batch) after an update with given
    gains K (nx, ny, batch).

    Joseph's form, P⁺ = (I − KH)P(I − KH)ᵀ + KRKᵀ, holds for any gain. The other arguments are those
    of `joseph_update`.
    """
    if isinstance(P, np.ndarray):
        M = identity(len(P), P.shape[-1]) - product(K, H)
    else:
        M = array_namespace(P).eye(len(P), dtype=P.dtype)[..., None] - product(K, H)
    P = sandwich(M, P)
    P += sandwich(K, R)
    P = P + P.swapaxes(0, 1)  # remove the asymmetry due to rounding
    P *= 0.5
    x = xhat.T + mapped(K, innovation).T
    return x.T, P
