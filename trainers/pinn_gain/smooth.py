"""Smoothed trajectories of a batch of records, from their outputs and the model's equations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.smoother import iterated
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.record import Record

PROCESS_NOISE = (30.0, 1.0)
"""Process noise, over the EKF's, of further attempts at records whose outputs the first attempt
does not explain; each later one begins from the trajectory of the one before."""
_PASSES = 8
"""Largest number of Gauss-Newton steps of an attempt."""
_SETTLED = 1e-3
"""Step, over the state's scale, below which a trajectory has converged."""
_BLOCK = 300_000
"""Approximate number of samples, over all rows, that are smoothed at a time."""
_WINDOW = 25
"""Length in samples of the windows in which residuals are tested."""
_DEVIATIONS = 6.0
"""Largest excess of a sum of squared residuals over its mean, in standard deviations."""


@dataclass(frozen=True)
class Smoothed:
    """The most probable trajectories of a batch of records."""

    xhat: np.ndarray
    """Shape (batch, num_samples, nx)."""
    explained: np.ndarray
    """Whether the residuals of the outputs are consistent with their noise, bool, shape (batch,).
    """


def smooth(record: Record, ekf: EKF) -> Smoothed:
    """Smooth whole records.

    The first attempt has the EKF's process noise and begins at its estimates. If its residuals are
    too large, because the filter diverged or the plant differs from the model, the record is
    smoothed again with more process noise, and from there with the EKF's.
    """
    first = smooth_once(record, ekf)
    xhat, explained = first.xhat, first.explained
    points, levels = xhat.copy(), np.where(explained, 1.0, np.inf)
    for level in PROCESS_NOISE:  # continuation in the process noise
        rows = np.flatnonzero(~explained)
        if not len(rows):
            break
        initial = points[rows] if level < PROCESS_NOISE[0] else None
        loose = replace(ekf, assumed_noise=level * ekf.assumed_noise)
        retried = smooth_once(record.rows(rows), loose, initial)
        points[rows] = retried.xhat
        better = rows[retried.explained]
        xhat[better], levels[better] = points[better], level
    return Smoothed(xhat, np.isfinite(levels))


def smooth_once(record: Record, ekf: EKF, points: np.ndarray | None = None) -> Smoothed:
    """Compute the maximum a posteriori trajectories of whole records.

    The iterated extended Kalman smoother is a Gauss-Newton method for the least-squares problem of
    prior, outputs and process noise (Bell 1994).

    Args:
        record: record of a batch of episodes.
        ekf: the EKF, which gives the model and both noises.
        points: states of the first linearisation, shape (batch, num_samples, nx); the EKF's own
            estimates if None.
    """
    count = max(1, _BLOCK // record.num_samples)  # rows that fit into memory
    parts = []
    with np.errstate(all="ignore"):
        for first in range(0, record.batch, count):
            rows = slice(first, first + count)
            about = None if points is None else points[rows].swapaxes(0, 1)
            block = record.rows(rows)
            path = iterated(ekf.system, block, [ekf.noise] * _PASSES, about, settled=_SETTLED)
            parts.append(path.xhat.swapaxes(0, 1))
        xhat = np.concatenate(parts)
        return Smoothed(xhat, _explains(ekf, record, xhat))


def _explains(ekf: EKF, record: Record, xhat: np.ndarray) -> np.ndarray:
    """Return whether the residuals are consistent with the output noise, bool (batch,).

    The sum of their squares is tested against the χ² distribution's mean and standard deviation,
    over the whole record and over windows.
    """
    present = ~np.isnan(record.y)
    error = ekf.system.output_residual(record.y, ekf.system.h(record.t, xhat, record.u))
    square = np.where(present, error**2 / np.einsum("iib->i", ekf.noise.R(0.0)), 0.0)
    window = min(_WINDOW, record.num_samples)
    consistent = np.isfinite(xhat).all(axis=(1, 2))
    for length in (window, record.num_samples):
        sums = [np.cumsum(a.sum(axis=-1), axis=1) for a in (square, present)]
        total, count = (np.diff(s[:, length - 1 :: length], axis=1, prepend=0) for s in sums)
        bound = count + _DEVIATIONS * np.sqrt(2 * count)
        consistent &= (total <= bound).all(axis=1)
    return np.asarray(consistent)
