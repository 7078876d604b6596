"""Kalman filters and smoothers over whole records, of the model linearised along the filter's own
estimates or about given states.

In these arrays samples come first, and in matrices the batch last.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.kalman import kalman_gain, observe, predict, update_with
from pinnobs_gym.simulation.matrices import divide_factored, factor, identity, product, sandwich
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

_ROWS = 2000
"""About how many samples of all rows are looked at at a time."""


@dataclass(frozen=True, eq=False)
class Path:
    """Estimates at the samples of a batch of records."""

    xhat: np.ndarray
    """Shape (num_samples, batch, nx)."""
    P: np.ndarray
    """Their covariances, shape (num_samples, nx, nx, batch)."""


@dataclass(frozen=True, eq=False)
class Filtered(Path):
    """What a forward pass leaves."""

    predicted: Path
    """The estimates before each sample is seen."""
    F: np.ndarray
    """Jacobians of the model's steps, shape (num_samples − 1, nx, nx, batch)."""
    Q: np.ndarray
    """Covariance of the process noise of a sample, shape (nx, nx, 1)."""
    K: np.ndarray
    """Kalman gains, shape (num_samples, nx, ny, batch)."""
    H: np.ndarray
    """Output Jacobians, shape (num_samples, ny, nx, batch); zero where an output is missing."""


def forward(
    system: System,
    record: Record,
    Q: np.ndarray,
    R: np.ndarray,
    about: np.ndarray | None = None,
    caution: float = 0.0,
) -> Filtered:
    """A Kalman filter over whole records.

    Args:
        system: the model.
        record: of a batch of episodes.
        Q: covariance of the process noise of a sample, shape (nx, nx, 1).
        R: covariance of the output noise, shape (ny, ny, batch or 1).
        about: states (num_samples, batch, nx) about which the model is linearised; the filter's own
            estimates if None, as in the extended Kalman filter.
        caution: which part of HPHᵀ is added to R, so that no sample moves an estimate all the way
            (as in Boutayeb & Aubry, "A strong tracking extended Kalman observer for nonlinear
            discrete-time systems", 1999).
    """
    t, n, batch, nx, ny = record.t, record.num_samples, record.batch, system.nx, system.ny
    y, u = record.y.swapaxes(0, 1), record.u.swapaxes(0, 1)
    x, P = record.prior.mean, record.prior.cov.transpose(1, 2, 0)
    before, after = (Path(np.empty((n, batch, nx)), np.empty((n, nx, nx, batch))) for _ in range(2))
    K, H = np.empty((n, nx, ny, batch)), np.empty((n, ny, nx, batch))
    ends, F = np.empty((0, batch, nx)), np.empty((n - 1, nx, nx, batch))
    if about is not None:
        ends, F = flows(system, t, about, u)
    for k in range(n):
        if k and about is None:
            x, P, F[k - 1] = predict(system, (t[k - 1], t[k]), x, P, Q, (u[k - 1], u[k]))
        elif k and about is not None:
            x = ends[k - 1] + np.einsum("ijb,bj->bi", F[k - 1], x - about[k - 1])
            P = sandwich(F[k - 1], P) + Q
        before.xhat[k], before.P[k] = x, P
        at = x if about is None else about[k]
        innovation, H[k] = observe(system, float(t[k]), at, y[k], u[k])
        if about is not None:
            innovation = innovation - np.einsum("pib,bi->bp", H[k], x - about[k])
        noise = R + caution * sandwich(H[k], P) if caution else R
        K[k], _ = kalman_gain(P, H[k], noise)
        x, P = update_with(K[k], x, P, innovation, H[k], noise)
        after.xhat[k], after.P[k] = x, P
    return Filtered(after.xhat, after.P, before, F, Q, K, H)


def backward(filtered: Filtered) -> Path:
    """Rauch, Tung & Striebel's pass back over what a forward pass left (Särkkä 2013, section 9.1).

    With C = PFᵀ(P⁻)⁻¹: x̂ₛ = x̂ + C(x̂ₛ' − x⁻') and, positive semidefinite in every term,
    Pₛ = (I − CF)P(I − CF)ᵀ + C(Pₛ' + Q)Cᵀ, primes marking the next sample.
    """
    x, P, before = filtered.xhat.copy(), filtered.P.copy(), filtered.predicted
    count = max(1, _ROWS // x.shape[1])
    for stop in range(len(x) - 1, 0, -count):
        start = max(stop - count, 0)
        C, own = _gains_back(filtered, start, stop)
        for k in range(stop - 1, start - 1, -1):
            gain = C[k - start]
            x[k] += np.einsum("ijb,bj->bi", gain, x[k + 1] - before.xhat[k + 1])
            smoothed = own[k - start] + sandwich(gain, P[k + 1])
            P[k] = (smoothed + smoothed.transpose(1, 0, 2)) / 2
    return Path(x, P)


def iterated(
    system: System,
    record: Record,
    Q: Sequence[np.ndarray],
    R: np.ndarray,
    about: np.ndarray | None = None,
    *,
    caution: float = 0.0,
    settled: float,
) -> Path:
    """The iterated Kalman smoother (Bell, "The iterated Kalman smoother as a Gauss-Newton method",
    1994): it minimises the squares of the innovations, of the departure from the prior and of the
    model's defects from sample to sample, each over its variance.

    Args:
        system: the model.
        record: of a batch of episodes.
        Q: covariance of the process noise of a sample, shape (nx, nx, 1), in each pass. A row is
            done when a pass with the last of them moves none of its states by more than
            ``settled``.
        R: covariance of the output noise, shape (ny, ny, batch or 1).
        about: states (num_samples, batch, nx) about which the first pass linearises the model; the
            filter's own estimates if None.
        caution: see `forward`; of a first pass along the filter's own estimates.
        settled: over the system's scale.

    Returns:
        The states of each row's last pass, and their covariances.
    """
    scale = np.asarray(system.scale, dtype=float)
    n, batch, nx = record.num_samples, record.batch, system.nx
    x, P = np.full((n, batch, nx), np.nan), np.full((n, nx, nx, batch), np.nan)
    if about is not None:
        x[:] = about
    rows, first = np.arange(batch), about is None
    for each in Q:
        at = None if first else x[:, rows]
        noise = R if R.shape[-1] == 1 else R[..., rows]
        left = record if len(rows) == batch else record.rows(rows)
        path = backward(forward(system, left, each, noise, at, caution if first else 0.0))
        moved = np.inf if at is None else (abs(path.xhat - at) / scale).max(axis=(0, 2))
        x[:, rows], P[..., rows] = path.xhat, path.P
        last = np.array_equal(each, Q[-1])
        done = ~np.isfinite(path.xhat).all(axis=(0, 2)) | (last & (moved <= settled))
        rows, first = rows[~done], False
        if not len(rows):
            break
    return Path(x, P)


def _gains_back(filtered: Filtered, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
    """C and (I − CF)P(I − CF)ᵀ + CQCᵀ of `backward` for some samples at once, (samples, nx, nx,
    batch): neither waits for what comes after."""
    parts = (
        filtered.P[start:stop],
        filtered.F[start:stop],
        filtered.predicted.P[start + 1 : stop + 1],
    )
    P, F, ahead = (a.transpose(1, 2, 0, 3).reshape(*a.shape[1:3], -1) for a in parts)
    L, _ = factor(ahead, np.zeros(ahead.shape[-1]))
    C = divide_factored(product(P, F.transpose(1, 0, 2)), L)
    own = sandwich(identity(len(C), C.shape[-1]) - product(C, F), P) + sandwich(C, filtered.Q)
    C, own = (a.reshape(*a.shape[:2], stop - start, -1).transpose(2, 0, 1, 3) for a in (C, own))
    return C, own


def flows(
    system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where the model comes to from the states x (num_samples, batch, nx) until the next sample,
    (num_samples − 1, batch, nx), and the Jacobians, (num_samples − 1, nx, nx, batch)."""
    n, batch, nx = x.shape
    ends, F = np.empty((n - 1, batch, nx)), np.empty((n - 1, nx, nx, batch))
    count = max(1, _ROWS // batch)
    for first in range(0, n - 1, count):
        size = min(count, n - 1 - first)
        starts, stops = slice(first, first + size), slice(first + 1, first + size + 1)
        t0, t1 = np.repeat(t[starts], batch), np.repeat(t[stops], batch)
        u0, u1 = (u[part].reshape(size * batch, u.shape[-1]) for part in (starts, stops))
        end, flow = model_step_jacobian(system, t0, t1, x[starts].reshape(-1, nx), u0, u1)
        ends[starts] = end.reshape(size, batch, nx)
        F[starts] = flow.reshape(size, batch, nx, nx).transpose(0, 2, 3, 1)
    return ends, F
