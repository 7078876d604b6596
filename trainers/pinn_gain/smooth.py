"""The trajectories behind a batch of records: what outputs and equations say of them afterwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.smoother import backward, forward
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import vector

PROCESS_NOISE = (30.0, 1.0)
"""Process noise, over the EKF's, of further attempts at records that the first leaves unexplained,
each beginning from the trajectory before."""
_PASSES = 8
"""Most Gauss-Newton steps of an attempt."""
_SETTLED = 1e-3
"""Largest step, over the state's scale, at which a trajectory no longer changes."""
_BLOCK = 300_000
"""Samples of all rows that are smoothed at a time."""
_WINDOW = 25
"""Samples over which the outputs must be explained."""
_DEVIATIONS = 6.0
"""Standard deviations of a mean squared residual up to which outputs count as explained."""


@dataclass(frozen=True)
class Smoothed:
    """The most probable trajectories of a batch of records."""

    xhat: np.ndarray
    """Shape (batch, num_samples, nx)."""
    explained: np.ndarray
    """Whether the residuals of the outputs are as small as their noise, everywhere: bool (batch,).
    """


def smooth(record: Record, ekf: EKF) -> Smoothed:
    """The trajectories that explain whole records, with the least process noise of those tried.

    The first attempt has the EKF's own process noise and begins from its estimates. For records
    that it leaves unexplained, since the filter was lost or the plant is not the model, the noise
    is raised and lowered again.
    """
    found = smooth_once(record, ekf)
    xhat, good = found.xhat, found.explained
    points, levels = xhat.copy(), np.where(good, 1.0, np.inf)
    for level in PROCESS_NOISE:
        rows = np.flatnonzero(~good)
        if not len(rows):
            break
        begin = points[rows] if level < PROCESS_NOISE[0] else None
        loose = replace(ekf, process_noise=level * ekf.process_noise)
        again = smooth_once(record.rows(rows), loose, begin)
        points[rows] = again.xhat
        better = rows[again.explained]
        xhat[better], levels[better] = points[better], level
    return Smoothed(xhat, np.isfinite(levels))


def smooth_once(record: Record, ekf: EKF, points: np.ndarray | None = None) -> Smoothed:
    """The trajectories of highest posterior density given whole records, by the iterated extended
    Kalman smoother: Gauss-Newton on the batch least-squares problem of prior, outputs and process
    noise (Bell 1994).

    Args:
        record: of a batch of episodes.
        ekf: says the model and both noises.
        points: where to linearise first, (batch, num_samples, nx); along the EKF's own estimates
            if None.
    """
    scale = vector(ekf.system.scale, ekf.system.nx, "scale")
    shape = (record.batch, record.num_samples, ekf.system.nx)
    xhat = np.full(shape, np.nan) if points is None else points.copy()
    rows = np.arange(record.batch)
    with np.errstate(all="ignore"):
        for k in range(_PASSES):
            at = None if k == 0 and points is None else xhat[rows]
            after = _blocks(ekf, record.rows(rows), at)
            change = np.inf if at is None else (abs(after - at) / scale).max(axis=(1, 2))
            xhat[rows] = after
            sound = np.isfinite(after).all(axis=(1, 2))
            rows = rows[sound & (change > _SETTLED)]
            if not len(rows):
                break
        return Smoothed(xhat, _explains(ekf, record, xhat))


def _explains(ekf: EKF, record: Record, xhat: np.ndarray) -> np.ndarray:
    """Whether outputs are where they should be, over the whole record and every window of it."""
    there = ~np.isnan(record.y)
    error = record.y - ekf.system.h(record.t, xhat, record.u)
    square = np.where(there, error**2 / ekf.output_variance, 0.0)
    window = min(_WINDOW, record.num_samples)
    good = np.isfinite(xhat).all(axis=(1, 2))
    for length in (window, record.num_samples):
        sums = [np.cumsum(a.sum(axis=-1), axis=1) for a in (square, there)]
        total, count = (np.diff(s[:, length - 1 :: length], axis=1, prepend=0) for s in sums)
        most = count + _DEVIATIONS * np.sqrt(2 * count)
        good &= (total <= most).all(axis=1)
    return np.asarray(good)


def _blocks(ekf: EKF, record: Record, points: np.ndarray | None) -> np.ndarray:
    """`_pass` in blocks of rows that fit into memory."""
    count = max(1, _BLOCK // record.num_samples)
    parts = []
    for first in range(0, record.batch, count):
        rows = slice(first, first + count)
        parts.append(_pass(ekf, record.rows(rows), None if points is None else points[rows]))
    return np.concatenate(parts)


def _pass(ekf: EKF, record: Record, points: np.ndarray | None) -> np.ndarray:
    """One Gauss-Newton step: filter and smoother of the model linearised at points (batch,
    num_samples, nx), or along the filter itself."""
    about = None if points is None else points.swapaxes(0, 1)
    path = backward(forward(ekf.system, record, *ekf.tuning(), about))
    return path.xhat.swapaxes(0, 1)
