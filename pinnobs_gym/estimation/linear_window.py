"""Smoothing over a window of samples by roots, of a model linearised about given states.

The minimum of (x₀ − x̄)ᵀP̄⁻¹(x₀ − x̄) + Σ‖w‖² + Σ‖e − H(x − r)‖² over all states of the window is a
Gauss-Newton step of the nonlinear problem (Bell, "The iterated Kalman smoother as a Gauss-Newton
method", 1994). It is computed by two filters (Fraser & Potter, "The optimum linear smoother as a
combination of two optimum linear filters", 1969): a Kalman filter forward that carries a root of
its covariances, and an information filter backward that carries a root of its information (Bierman
1977, "Factorization Methods for Discrete Sequential Estimation"; Paige & Saunders 1977). All steps
are QR factorisations. No covariance is inverted and nothing is subtracted from one, so that
neither a wide prior, nor states without process noise, nor a contracting plant costs digits.

Here the batch is the axis before vectors and matrices. These are contiguous in memory, so that the
sums of a row are formed in the same order in batches of any size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.estimation.kalman import observe
from pinnobs_gym.estimation.smoother import flows
from pinnobs_gym.estimation.square_root import compressed, root_of, substituted
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True, eq=False)
class LinearWindow:
    """The model x' = r' + d + F(x − r) + Gw from each sample to the next, and the outputs e = H(x −
    r) + v, where r are given states, and w and v are standard normal."""

    r: np.ndarray
    """States of linearisation, shape (num_samples, batch, nx)."""
    d: np.ndarray
    """Defects φ(r) − r', shape (num_samples − 1, batch, nx)."""
    F: np.ndarray
    """Jacobians of the steps, shape (num_samples − 1, batch, nx, nx)."""
    G: np.ndarray
    """Roots of the process noise over the steps, shape (num_samples − 1, batch, nx, m)."""
    e: np.ndarray
    """Output errors at r, divided by a root of R, shape (num_samples, batch, ny); zero where y is
    missing."""
    H: np.ndarray
    """Output Jacobians, divided likewise, shape (num_samples, batch, ny, nx)."""


@dataclass(frozen=True, eq=False)
class Smoothed:
    """The states of a window given all of its outputs."""

    x: np.ndarray
    """Estimates, shape (num_samples, batch, nx)."""
    root: np.ndarray
    """Roots of their covariances, shape (num_samples, batch, nx, nx)."""
    predicted_root: np.ndarray
    """Roots of the covariances given the outputs before each sample, of the same shape."""
    M: np.ndarray
    """Jacobians of each smoothed state with respect to the one before, shape (num_samples − 1,
    batch, nx, nx)."""


def linear_window(
    system: System,
    noise: Noise,
    t: Sequence[float],
    y: Sequence[np.ndarray],
    u: Sequence[np.ndarray],
    r: np.ndarray,
    exact: bool = False,
) -> LinearWindow:
    """Linearise the model about the states r (num_samples, batch, nx).

    Args:
        system: the model.
        noise: the noise.
        t: sample times in s.
        y: outputs (batch, ny) at each time; NaN marks a missing output.
        u: inputs (batch, nu) at each time.
        r: states of linearisation.
        exact: whether the process noise is left out.
    """
    n, batch, nx = r.shape
    r = np.ascontiguousarray(r)
    ends, F, Q = flows(system, noise, np.array(t), r, np.array(u).reshape(n, batch, -1))
    G = np.zeros((n - 1, batch, nx, 0))
    if not exact and n > 1:
        whole = Q.transpose(0, 3, 1, 2).reshape(-1, nx, nx)
        G = np.ascontiguousarray(root_of(whole)).reshape(n - 1, batch, nx, nx)
    e, H = np.empty((n, batch, system.ny)), np.empty((n, batch, system.ny, nx))
    for k in range(n):
        e[k], H[k] = whitened(system, noise, (float(t[k]), y[k], u[k]), r[k])
    F = np.ascontiguousarray(F.transpose(0, 3, 1, 2))
    return LinearWindow(r, system.state_residual(ends, r[1:]), F, G, e, H)


def whitened(
    system: System, noise: Noise, sample: tuple[float, np.ndarray, np.ndarray], x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the output errors (batch, ny) at states x (batch, nx), and the output Jacobians
    (batch, ny, nx), both divided by a root of R. A sample is its time in s, outputs and inputs."""
    t, y, u = sample
    innovation, H = observe(system, t, x, y, u)
    T = root_of(noise.R(t, y).transpose(2, 0, 1))
    T = np.ascontiguousarray(np.broadcast_to(T, (len(x), *T.shape[1:])))
    both = np.concatenate([innovation[..., None], H.transpose(2, 0, 1)], axis=2)
    both = substituted(T, both)
    return both[..., 0], both[..., 1:]


def smoothed(window: LinearWindow, deviation: np.ndarray, root: np.ndarray) -> Smoothed:
    """Return the states of a window, given the mean of its first state, less r (batch, nx), and a
    root (batch, nx, nx) of its covariance, both without the window's outputs."""
    n, batch, nx = window.r.shape
    A, b, M = _backward(window)
    before, L = _forward(window, deviation, root)
    # At each sample, x = r + before + Lz; later outputs say ‖A(x − r) − b‖², the earlier ones ‖z‖².
    rest = b - (A @ before[..., None])[..., 0]
    upper = np.broadcast_to(np.eye(nx, nx + 1), (n, batch, nx, nx + 1))
    lower = np.concatenate([A @ L, rest[..., None]], axis=-1)
    T = _triangle(np.concatenate([upper, lower], axis=-2)).reshape(n * batch, nx + 1, nx + 1)
    transposed = T[:, :nx, :nx].swapaxes(1, 2)
    inverse = substituted(
        transposed, np.broadcast_to(np.eye(nx), transposed.shape), transposed=True
    )
    z = substituted(transposed, T[:, :nx, nx:], transposed=True).reshape(n, batch, nx, 1)
    x = window.r + before + (L @ z)[..., 0]
    return Smoothed(x, L @ inverse.reshape(n, batch, nx, nx), L, M)


def joint_covariance(states: Smoothed, rows: np.ndarray) -> np.ndarray:
    """Return the covariances (rows, num_samples·nx, num_samples·nx) of all states of a window
    together, in some rows of the batch."""
    root, M = (np.ascontiguousarray(part[:, rows]) for part in (states.root, states.M))
    n, batch, nx, _ = root.shape
    P = np.empty((batch, n, nx, n, nx))
    for k in range(n):
        column = root[k] @ root[k].swapaxes(1, 2)
        P[:, k, :, k] = column
        for j in range(k + 1, n):  # Cov(x_j, x_k) = M Cov(x_{j−1}, x_k)
            column = M[j - 1] @ column
            P[:, j, :, k], P[:, k, :, j] = column, column.swapaxes(1, 2)
    return P.reshape(batch, n * nx, n * nx)


def _forward(
    window: LinearWindow, deviation: np.ndarray, L: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the Kalman filter's predictions (num_samples, batch, nx), less r, and the roots of
    their covariances, given those of the first sample."""
    _, batch, ny, nx = window.H.shape
    deviations, roots = [deviation], [L]
    rows = np.zeros((batch, ny + nx, ny + nx + window.G.shape[-1]))
    rows[:, :ny, :ny] = np.eye(ny)
    for k in range(len(window.F)):
        # QR of [[I, HL, 0], [0, FL, G]]ᵀ is [[√S, 0], [FK√S, L']]ᵀ: an update and a prediction.
        rows[:, :ny, ny : ny + nx] = window.H[k] @ L
        rows[:, ny:, ny : ny + nx] = window.F[k] @ L
        rows[:, ny:, ny + nx :] = window.G[k]
        array = compressed(rows)
        innovation = window.e[k] - (window.H[k] @ deviation[..., None])[..., 0]
        step = array[:, ny:, :ny] @ substituted(array[:, :ny, :ny], innovation[..., None])
        deviation = window.d[k] + (window.F[k] @ deviation[..., None] + step)[..., 0]
        L = array[:, ny:, ny:]
        deviations.append(deviation)
        roots.append(L)
    return np.ascontiguousarray(np.stack(deviations)), np.ascontiguousarray(np.stack(roots))


def _backward(window: LinearWindow) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A (num_samples, batch, nx, nx) and b (num_samples, batch, nx) for which the outputs of
    a sample and of those after it say ‖A(x − r) − b‖² of its state, and `Smoothed.M`."""
    n, batch, ny, nx = window.H.shape
    m = window.G.shape[-1]
    A, b, M = np.zeros((n, batch, nx, nx)), np.zeros((n, batch, nx)), np.empty(window.F.shape)
    for k in reversed(range(n)):
        rows = np.zeros((batch, m + nx + ny, m + nx + 1))
        rows[:, m + nx :, m : m + nx] = window.H[k]
        rows[:, m + nx :, -1] = window.e[k]
        if k < n - 1:
            # The next state is d + F(x − r) + Gw, and w is standard normal.
            ahead, G = A[k + 1], window.G[k]
            rows[:, :m, :m] = np.eye(m)
            rows[:, m : m + nx, :m] = ahead @ G
            rows[:, m : m + nx, m:-1] = ahead @ window.F[k]
            rows[:, m : m + nx, -1] = b[k + 1] - (ahead @ window.d[k, :, :, None])[..., 0]
        T = _triangle(rows)
        A[k], b[k] = T[:, m : m + nx, m:-1], T[:, m : m + nx, -1]
        if k < n - 1:
            # The minimum over w for a given x has the slope −T_ww⁻¹T_wx.
            slope = substituted(T[:, :m, :m].swapaxes(1, 2), T[:, :m, m:-1], transposed=True)
            M[k] = window.F[k] - window.G[k] @ slope
    return A, b, M


def _triangle(rows: np.ndarray) -> np.ndarray:
    """Return the upper triangular factor R of the QR factorisation of matrices (..., n, m)."""
    R: Any = np.linalg.qr(rows, mode="r")
    return R
