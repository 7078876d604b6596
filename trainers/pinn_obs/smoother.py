"""Kalman filters and smoothers over the samples of one episode, as the guide needs them.

The iterated smoother (Bell, "The iterated Kalman smoother as a Gauss-Newton method", 1994)
minimises the squares of the innovations, of the departure from the prior and of the model's defects
from sample to sample, each over its variance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.record import Record
from pinnobs_gym.simulate import model_step_jacobian
from pinnobs_gym.system import System, vector

DRIFT = 1e-4
"""Standard deviation of the model's defect from one sample to the next, over the scale."""
_PASSES = 12
_WIDE, _NARROWING = 1e-2, 0.6
_SETTLED = 1e-4


@dataclass(frozen=True, eq=False)
class Path:
    """Estimates at the samples of one episode."""

    xhat: np.ndarray
    """Shape (num_samples, nx)."""
    P: np.ndarray
    """Their covariances, shape (num_samples, nx, nx)."""


@dataclass(frozen=True, eq=False)
class Filtered(Path):
    """What a forward pass leaves."""

    predicted: Path
    """The estimates before each sample is seen."""
    F: np.ndarray
    """Jacobians of the model's steps, shape (num_samples − 1, nx, nx)."""
    K: np.ndarray
    """Kalman gains, shape (num_samples, nx, ny)."""
    H: np.ndarray
    """Output Jacobians, shape (num_samples, ny, nx); zero where an output is missing."""


def smooth(system: System, record: Record, noise: np.ndarray, caution: float) -> Path:
    """The iterated Kalman smoother, begun with the estimates of an extended Kalman smoother.

    If its passes do not settle, it begins again with more process noise, which it then takes away
    again pass by pass.

    Args:
        system: the model.
        record: the samples.
        noise: standard deviations of the output noise, shape (ny,), in output units; positive.
        caution: see `forward`; of the first pass.
    """
    path = backward(forward(system, record, noise, caution=caution))
    narrowed = _WIDE * _NARROWING ** np.arange(2 * _PASSES)
    for drift in (*[DRIFT] * _PASSES, *np.maximum(narrowed, DRIFT)):
        before = path.xhat
        path = backward(forward(system, record, noise, about=before, drift=drift))
        settled = (abs(path.xhat - before) <= _SETTLED * np.asarray(system.scale)).all()
        if settled and drift == DRIFT:
            break
    return path


def forward(
    system: System,
    record: Record,
    noise: np.ndarray,
    *,
    about: np.ndarray | None = None,
    drift: float = DRIFT,
    caution: float = 0.0,
) -> Filtered:
    """A Kalman filter over the samples of one episode.

    Args:
        system: the model.
        record: the samples.
        noise: standard deviations of the output noise, shape (ny,), in output units; positive.
        about: states (num_samples, nx) about which the model is linearised; the filter's own
            estimates if None, as in the extended Kalman filter.
        drift: standard deviation of the process noise per sample, over the scale.
        caution: which part of CPCᵀ is added to the noise, so that no sample moves an estimate all
            the way (as in Boutayeb & Aubry, "A strong tracking extended Kalman observer for
            nonlinear discrete-time systems", 1999).
    """
    n, nx, ny = record.num_samples, system.nx, system.ny
    y, u, t = record.y[0], record.u[0], record.t
    Q = np.diag((drift * vector(system.scale, nx, "scale")) ** 2)
    x, P = record.prior.mean[0], record.prior.cov[0]
    before, after = (Path(np.empty((n, nx)), np.empty((n, nx, nx))) for _ in range(2))
    steps, F = (None, np.empty((n - 1, nx, nx))) if about is None else flows(system, t, about, u)
    K, H = np.empty((n, nx, ny)), np.empty((n, ny, nx))
    for k in range(n):
        if k:
            if steps is None or about is None:
                ends = t[k - 1], t[k], x[None], u[k - 1, None], u[k, None]
                (x,), F[k - 1, None] = model_step_jacobian(system, *ends)
            else:
                x = steps[k - 1] + F[k - 1] @ (x - about[k - 1])
            P = F[k - 1] @ P @ F[k - 1].T + Q
        before.xhat[k], before.P[k] = x, P
        at, missing = x if about is None else about[k], np.isnan(y[k])
        H[k] = np.where(missing[:, None], 0.0, system.h_jacobian(at))
        innovation = np.where(missing, 0.0, y[k] - system.h(at) - H[k] @ (x - at))
        HP = H[k] @ P
        R = np.diag(noise**2) + caution * HP @ H[k].T
        K[k] = np.linalg.solve(HP @ H[k].T + R, HP).T
        M = np.eye(nx) - K[k] @ H[k]
        x, P = x + K[k] @ innovation, M @ P @ M.T + K[k] @ R @ K[k].T
        after.xhat[k], after.P[k] = x, P
    return Filtered(after.xhat, after.P, before, F, K, H)


def backward(filtered: Filtered) -> Path:
    """Rauch, Tung & Striebel's pass back over what a forward pass left."""
    x, P, before = filtered.xhat.copy(), filtered.P.copy(), filtered.predicted
    for k in range(len(x) - 2, -1, -1):
        ahead = before.P[k + 1]
        size = np.sqrt(np.diagonal(ahead))
        correlations = ahead / np.outer(size, size)  # far better conditioned than covariances
        gain = np.linalg.solve(correlations, (filtered.F[k] @ P[k]) / size[:, None]).T / size
        x[k] += gain @ (x[k + 1] - before.xhat[k + 1])
        P[k] += gain @ (P[k + 1] - ahead) @ gain.T
    return Path(x, P)


def flows(
    system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What `model_step_jacobian` returns, but for all intervals between samples at once: the states
    (num_samples − 1, nx) at their ends and the Jacobians (num_samples − 1, nx, nx)."""
    start, length = t[:-1], np.diff(t)
    longest = system.model_step or system.setups["benchmark"].dt
    count = max(1, int(np.ceil(length.max() / longest - 1e-6)))
    step = (length / count)[:, None]

    def rates(part: float, z: np.ndarray, F: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        now = start + part / count * length
        measured = u[:-1] + part / count * (u[1:] - u[:-1])
        inputs = measured if system.measured_input else system.input(now)
        return system.f(now, z, inputs), system.f_jacobian(now, z, inputs) @ F

    z, h = x[:-1], step[..., None]
    F = np.broadcast_to(np.eye(system.nx), (len(z), system.nx, system.nx))
    for k in range(count):
        k1, K1 = rates(k, z, F)
        k2, K2 = rates(k + 0.5, z + step / 2 * k1, F + h / 2 * K1)
        k3, K3 = rates(k + 0.5, z + step / 2 * k2, F + h / 2 * K2)
        k4, K4 = rates(k + 1, z + step * k3, F + h * K3)
        z = z + step / 6 * (k1 + 2 * (k2 + k3) + k4)
        F = F + h / 6 * (K1 + 2 * (K2 + K3) + K4)
    return z, F
