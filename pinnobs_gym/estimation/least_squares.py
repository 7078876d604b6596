"""Least squares over a window of samples: the outputs linearised in the window's first state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.kalman import observe
from pinnobs_gym.simulation.matrices import divide, mapped, product, squared_size
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class Fit:
    """A trajectory of the model, and the normal equations of its fit to the outputs.

    If parameters θ move the first state by Xθ, with X the first of the derivatives below, the sum
    of squared output errors over R is approximately
    ``cost`` − 2·``right``ᵀθ + θᵀ·``information``·θ.
    """

    cost: np.ndarray
    """Sum of squared output errors over R, shape (batch,)."""
    information: np.ndarray
    """ΣGᵀR⁻¹G, shape (n, n, batch), where G are the derivatives of the outputs by θ."""
    right: np.ndarray
    """ΣGᵀR⁻¹e, shape (n, batch), where e are the output errors."""
    x: np.ndarray
    """States along the trajectory, shape (num_samples, batch, nx)."""
    X: np.ndarray
    """Derivatives of the states by θ, shape (num_samples, nx, n, batch)."""


def linearised(
    system: System,
    noise: Noise,
    t: Sequence[float] | np.ndarray,
    y: Sequence[np.ndarray] | np.ndarray,
    u: Sequence[np.ndarray] | np.ndarray,
    x: np.ndarray,
    X: np.ndarray,
) -> Fit:
    """Simulate the model from x, and form the normal equations of the output errors.

    Args:
        system: the model.
        noise: the noise, of which the output noise is used.
        t: sample times in s, num_samples of them.
        y: outputs (batch, ny) at each time; NaN marks a missing output.
        u: inputs (batch, nu) at each time.
        x: states at the first time, shape (batch, nx).
        X: derivatives of x by the parameters, shape (nx, n, batch).
    """
    n, batch = X.shape[1:]
    cost, right = np.zeros(batch), np.zeros((n, batch))
    information = np.zeros((n, n, batch))
    states, derivatives = np.empty((len(t), *x.shape)), np.empty((len(t), *X.shape))
    for k in range(len(t)):
        if k:  # propagate the state and its sensitivity
            times = float(t[k - 1]), float(t[k])
            x, F = model_step_jacobian(system, *times, x, u[k - 1], u[k])
            X = product(F.transpose(1, 2, 0), X)
        states[k], derivatives[k] = x, X
        error, H = observe(system, float(t[k]), x, y[k], u[k])  # zero where y is missing
        G = product(H, X)
        # Accumulate the normal equations.
        R = noise.R(float(t[k]), y[k])
        weighted = divide(G.transpose(1, 0, 2), R)
        cost += squared_size(error, R)
        right += mapped(weighted, error).T
        information += product(weighted, G)
    return Fit(cost, information, right, states, derivatives)


def root(P: np.ndarray) -> np.ndarray:
    """Return L with LLᵀ = P, both (nx, nx, batch), for P symmetric and positive semidefinite."""
    values, vectors = np.linalg.eigh(P.transpose(2, 0, 1))  # Cholesky fails for a singular P
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None]).transpose(1, 2, 0)


def solved(information: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve information·θ = right for θ (n, batch); NaN where the information is not finite."""
    A = information.transpose(2, 0, 1)
    finite = np.isfinite(A).all(axis=(1, 2))
    theta = np.full(right.shape, np.nan)
    theta[:, finite] = np.linalg.solve(A[finite], right.T[finite][..., None])[..., 0].T
    return theta
