"""Extended Kalman filters and smoothers over whole records.

The model is linearised at the filter's own estimates or at given states. The first axis of all
arrays is that of the samples; the last axis of matrices is that of the batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.estimation.kalman import cautious, kalman_gain, observe, predict, update_with
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.simulation.matrices import (
    cholesky,
    divide_factored,
    factor,
    identity,
    mapped,
    product,
    sandwich,
)
from pinnobs_gym.simulation.model import model_step_moments
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.truth import rows_of

_ROWS = 2000
"""Approximate number of samples, over all rows, that are processed at a time."""

LEAST = 1e-10
"""Least eigenvalue of correlations below which the smoother's inverse loses too many digits. Its
covariances are then off by about 1e-7 in relative terms."""


@dataclass(frozen=True, eq=False)
class Path:
    """Estimates at the samples of a batch of records."""

    xhat: np.ndarray
    """Shape (num_samples, batch, nx)."""
    P: np.ndarray
    """Covariances of the estimates, shape (num_samples, nx, nx, batch)."""


@dataclass(frozen=True, eq=False)
class Filtered(Path):
    """Result of a forward pass."""

    predicted: Path
    """Predictions, before the update by each sample."""
    F: np.ndarray
    """Jacobians of the model's steps, shape (num_samples − 1, nx, nx, batch)."""
    Q: np.ndarray
    """Covariances of the process noise over the steps, shape (num_samples − 1, nx, nx, batch)."""
    K: np.ndarray
    """Kalman gains, shape (num_samples, nx, ny, batch)."""
    H: np.ndarray
    """Output Jacobians, shape (num_samples, ny, nx, batch); zero for a missing output."""


def forward(
    system: System,
    record: Record,
    noise: Noise,
    about: np.ndarray | None = None,
    caution: float = 0.0,
) -> Filtered:
    """Run a Kalman filter over whole records.

    Args:
        system: the model.
        record: record of a batch of episodes.
        noise: the noise.
        about: states (num_samples, batch, nx) of linearisation; the filter's own estimates if None,
            as in the extended Kalman filter.
        caution: fraction of HPHᵀ that is added to R, which shortens every update (as in Boutayeb &
            Aubry, "A strong tracking extended Kalman observer for nonlinear discrete-time systems",
            1999).
    """
    t, n, batch, nx, ny = record.t, record.num_samples, record.batch, system.nx, system.ny
    y, u = record.y.swapaxes(0, 1), record.u.swapaxes(0, 1)
    x, P = record.prior.mean, record.prior.cov.transpose(1, 2, 0)
    before, after = (Path(np.empty((n, batch, nx)), np.empty((n, nx, nx, batch))) for _ in range(2))
    K, H = np.empty((n, nx, ny, batch)), np.empty((n, ny, nx, batch))
    box = system.state_box
    ends, F, Q = np.empty((0, batch, nx)), *(np.empty((n - 1, nx, nx, batch)) for _ in range(2))
    if about is not None:
        ends, F, Q = flows(system, noise, t, about, u)
    for k in range(n):
        # Prediction: of the EKF, or by the steps linearised about the given states.
        if k and about is None:
            times, inputs = (t[k - 1], t[k]), (u[k - 1], u[k])
            x, P, F[k - 1], Q[k - 1] = predict(system, times, x, P, noise, inputs)
        elif k and about is not None:
            x = ends[k - 1] + mapped(F[k - 1], system.state_residual(x, about[k - 1]))
            P = sandwich(F[k - 1], P) + Q[k - 1]
        before.xhat[k], before.P[k] = x, P
        # Innovation, with h linearised about the same states.
        at = x if about is None else about[k]
        innovation, H[k] = observe(system, float(t[k]), at, y[k], u[k])
        if about is not None:
            innovation = innovation - mapped(H[k], system.state_residual(x, about[k]))
        # Update.
        R = cautious(P, H[k], noise.R(float(t[k]), y[k]), caution)
        K[k], _ = kalman_gain(P, H[k], R)
        x, P = update_with(K[k], x, P, innovation, H[k], R)
        if box is not None and about is None:
            x = nearest(x, P.transpose(2, 0, 1), box)
        after.xhat[k], after.P[k] = x, P
    return Filtered(after.xhat, after.P, before, F, Q, K, H)


def ill_conditioned(filtered: Filtered) -> np.ndarray:
    """Return the rows (number,) whose predicted covariances are finite, but too near to singular
    for the inverse in `backward`: of correlations, the least eigenvalue is less than `LEAST`."""
    P = np.ascontiguousarray(filtered.predicted.P[1:].transpose(1, 2, 0, 3))
    n, batch = P.shape[0], P.shape[3]
    P = P.reshape(n, n, -1)
    with np.errstate(invalid="ignore", divide="ignore"):
        L, variances = cholesky(P, semidefinite=True), np.einsum("iib->ib", P)
        # The determinant of correlations is not greater than the least eigenvalue times e.
        pivots = np.square(np.einsum("iib->ib", L)) / variances
        near = np.flatnonzero((pivots.prod(axis=0) < np.e * LEAST) & np.isfinite(P).all((0, 1)))
        std = np.sqrt(variances[:, near])
        correlations = (P[..., near] / (std[:, None] * std)).transpose(2, 0, 1)
    correlations = np.where(np.isfinite(correlations), correlations, np.eye(n))
    small = np.linalg.eigvalsh(correlations)[:, 0] < LEAST
    return np.unique(near[small] % batch)


def backward(filtered: Filtered) -> Path:
    """Run the Rauch-Tung-Striebel smoother over a forward pass (Särkkä 2013, section 9.1).

    With C = PFᵀ(P⁻')⁻¹, where primes mark the next sample: x̂ₛ = x̂ + C(x̂ₛ' − x⁻') and
    Pₛ = (I − CF)P(I − CF)ᵀ + C(Pₛ' + Q)Cᵀ, every term of which is positive semidefinite.
    """
    x, P, before = filtered.xhat.copy(), filtered.P.copy(), filtered.predicted
    count = max(1, _ROWS // x.shape[1])
    for stop in range(len(x) - 1, 0, -count):  # gains of a block at once, then the recursion
        start = max(stop - count, 0)
        C, own = _gains_back(filtered, start, stop)
        for k in range(stop - 1, start - 1, -1):
            gain = C[k - start]
            x[k] += mapped(gain, x[k + 1] - before.xhat[k + 1])
            smoothed = own[k - start] + sandwich(gain, P[k + 1])
            P[k] = (smoothed + smoothed.transpose(1, 0, 2)) / 2  # against rounding
    return Path(x, P)


def iterated(
    system: System,
    record: Record,
    noises: Sequence[Noise],
    about: np.ndarray | None = None,
    *,
    caution: float = 0.0,
    settled: float,
) -> Path:
    """Run the iterated Kalman smoother.

    It is a Gauss-Newton method (Bell, "The iterated Kalman smoother as a Gauss-Newton method",
    1994) for the sum of squares, each over its variance, of the output errors, of the deviation
    from the prior, and of the model's defects from sample to sample.

    Args:
        system: the model.
        record: record of a batch of episodes.
        noises: the noise of each pass. A row has converged when a pass with the last one moves none
            of its states by more than ``settled``. Output noise does not differ between rows.
        about: states (num_samples, batch, nx) of the first linearisation; the filter's own
            estimates if None.
        caution: see `forward`; it applies to the first pass, and only if ``about`` is None.
        settled: tolerance of convergence, over the system's scale.

    Returns:
        The states of each row's last pass, and their covariances.
    """
    scale = np.asarray(system.scale, dtype=float)
    n, batch, nx = record.num_samples, record.batch, system.nx
    x, P = np.full((n, batch, nx), np.nan), np.full((n, nx, nx, batch), np.nan)
    if about is not None:
        x[:] = about
    rows, first = np.arange(batch), about is None
    for noise in noises:
        at = None if first else x[:, rows]
        remaining = record if len(rows) == batch else record.rows(rows)
        # One Gauss-Newton step: filter and smooth the model linearised at the last trajectory.
        path = backward(forward(system, remaining, noise, at, caution if first else 0.0))
        moved: Any = np.inf
        if at is not None:
            moved = (abs(system.state_residual(path.xhat, at)) / scale).max(axis=(0, 2))
        x[:, rows], P[..., rows] = path.xhat, path.P
        # Drop the rows that have converged or diverged.
        last = noise is noises[-1]
        done = ~np.isfinite(path.xhat).all(axis=(0, 2)) | (last & (moved <= settled))
        rows, first = rows[~done], False
        if not len(rows):
            break
    return Path(x, P)


def _gains_back(filtered: Filtered, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """Return C and (I − CF)P(I − CF)ᵀ + CQCᵀ of `backward`, (samples, nx, nx, batch) each.

    Neither depends on the smoothed estimates, so they are computed for many samples at once.
    """
    parts = (
        filtered.P[start:stop],
        filtered.F[start:stop],
        filtered.predicted.P[start + 1 : stop + 1],
        filtered.Q[start:stop],
    )
    P, F, ahead, Q = (
        np.ascontiguousarray(a.transpose(1, 2, 0, 3)).reshape(*a.shape[1:3], -1) for a in parts
    )
    L, _ = factor(ahead, np.zeros(ahead.shape[-1]))
    C = divide_factored(product(P, F.transpose(1, 0, 2)), L)
    own = sandwich(identity(len(C), C.shape[-1]) - product(C, F), P) + sandwich(C, Q)
    C, own = (a.reshape(*a.shape[:2], stop - start, -1).transpose(2, 0, 1, 3) for a in (C, own))
    return C, own


def flows(
    system: System, noise: Noise, t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predict from the states x (num_samples, batch, nx) to the next samples.

    Returns:
        The predictions (num_samples − 1, batch, nx), their Jacobians, and the covariances of the
        process noise, (num_samples − 1, nx, nx, batch) each.
    """
    n, batch, nx = x.shape
    ends, (F, Q) = np.empty((n - 1, batch, nx)), np.empty((2, n - 1, nx, nx, batch))
    count = max(1, _ROWS // batch)
    alike = (part[i : i + count] for part in _alike(system, t) for i in range(0, len(part), count))
    for starts in alike:
        size, stops = len(starts), starts + 1
        t0, t1 = np.repeat(t[starts], batch), np.repeat(t[stops], batch)
        u0, u1 = (u[part].reshape(size * batch, u.shape[-1]) for part in (starts, stops))
        each = rows_of(system, np.tile(np.arange(batch), size))
        end, *moved = model_step_moments(each, noise, t0, t1, x[starts].reshape(-1, nx), u0, u1)
        ends[starts] = end.reshape(size, batch, nx)
        for whole, part in zip((F, Q), moved, strict=True):
            part = np.broadcast_to(part, (nx, nx, size * batch)).reshape(nx, nx, size, batch)
            whole[starts] = part.transpose(2, 0, 1, 3)
    return ends, F, Q


def _alike(system: System, t: np.ndarray) -> list[np.ndarray]:
    """Return the numbers of the intervals between times t (s), those together for which the model
    takes the same number of steps: all rows of a call take that of the one with the most."""
    start, end = t[:-1], t[1:]
    if system.discrete or system.stiff or system.own_flow or not len(start):
        return [np.arange(len(start))]
    number = np.maximum(np.ceil((end - start) / longest_step(system) - 1e-6), 1)
    for k, at in enumerate(system.breakpoints()):  # it parts the interval in which it is
        number[(start < at) & (at < end)] = -1 - k
    return [np.flatnonzero(number == each) for each in np.unique(number)]
