"""The trajectories behind a batch of records: what outputs and equations say of them afterwards."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.smoother import iterated
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record

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
    Q, R = ekf.tuning()
    count = max(1, _BLOCK // record.num_samples)  # rows that fit into memory
    parts = []
    with np.errstate(all="ignore"):
        for first in range(0, record.batch, count):
            rows = slice(first, first + count)
            about = None if points is None else points[rows].swapaxes(0, 1)
            block = record.rows(rows)
            path = iterated(ekf.system, block, [Q] * _PASSES, R, about, settled=_SETTLED)
            parts.append(path.xhat.swapaxes(0, 1))
        xhat = np.concatenate(parts)
        return Smoothed(xhat, _explains(ekf, record, xhat))


def _explains(ekf: EKF, record: Record, xhat: np.ndarray) -> np.ndarray:
    """Whether outputs are where they should be, over the whole record and every window of it."""
    present = ~np.isnan(record.y)
    error = record.y - ekf.system.h(record.t, xhat, record.u)
    square = np.where(present, error**2 / ekf.output_variance, 0.0)
    window = min(_WINDOW, record.num_samples)
    good = np.isfinite(xhat).all(axis=(1, 2))
    for length in (window, record.num_samples):
        sums = [np.cumsum(a.sum(axis=-1), axis=1) for a in (square, present)]
        total, count = (np.diff(s[:, length - 1 :: length], axis=1, prepend=0) for s in sums)
        most = count + _DEVIATIONS * np.sqrt(2 * count)
        good &= (total <= most).all(axis=1)
    return np.asarray(good)
