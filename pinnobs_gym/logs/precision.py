"""How well logs tell the unknowns of a fit, and whether the fit explains the logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.innovation_tests import robust_std
from pinnobs_gym.logs.outlier_tests import outliers_of
from pinnobs_gym.simulation.matrices import cholesky

_LOST = 1e-10
"""Eigenvalue of the scaled information below which the logs say nothing of a direction."""
_SHARE = 0.1
"""Share of an unknown in such a direction, squared, from which it is named."""
_CHANCE = 1e-4
"""Probability of so many residuals far beyond the others below which they are not chance."""


@dataclass(frozen=True)
class Precision:
    """The covariance of estimated unknowns."""

    std: np.ndarray
    """Standard errors, shape (n,): infinite where the logs do not tell an unknown, and NaN where it
    is held at a bound."""
    correlation: np.ndarray
    """Their correlations, shape (n, n); zero with those that have no standard error."""


def precision(information: np.ndarray, held: np.ndarray) -> Precision:
    """Return the covariance that belongs to an information matrix (n, n), its inverse, given that
    some unknowns, bool (n,), are held at what they are."""
    n, free = len(information), np.flatnonzero(~held)
    std, correlation = np.full(n, np.nan), np.eye(n)
    own = information[np.ix_(free, free)]
    diagonal = np.diagonal(own)
    size = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(own / np.outer(size, size))
    lost = values < _LOST
    untold = (vectors[:, lost] ** 2 > _SHARE).any(axis=1)
    inverse = np.where(lost, 0.0, 1 / np.where(lost, 1.0, values))
    cov = (vectors * inverse) @ vectors.T
    variance = np.diagonal(cov)
    std[free] = np.where(untold, np.inf, np.sqrt(np.maximum(variance, 0)) / size)
    root = np.sqrt(np.where(variance > 0, variance, 1.0))
    known = np.outer(~untold, ~untold) & ~np.eye(len(free), dtype=bool)
    correlation[np.ix_(free, free)] += np.where(known, cov / np.outer(root, root), 0.0)
    return Precision(std, correlation)


@dataclass(frozen=True)
class Residuals:
    """What residuals, of one output, say of a fit."""

    ratio: float
    """Their root mean square over the expected standard deviation; NaN without any output."""
    serial: float
    """Their correlation from one sample to the next; NaN if there are too few."""
    far: float
    """Share of those far beyond the others, zero where they may be chance."""
    tail: float
    """Their root mean square over that of normal values with the same median size; 1 if unknown."""


def residuals_of(whitened: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> list[Residuals]:
    """Return what the residuals of each output say.

    Args:
        whitened: those of each log in standard deviations, independent of each other, shape
            (num_samples, ny).
        y: outputs, of the same shape; NaN marks a missing one.
    """
    return [
        _residuals([r[:, j] for r in whitened], [~np.isnan(each[:, j]) for each in y])
        for j in range(y[0].shape[1])
    ]


def _residuals(whitened: Sequence[np.ndarray], present: Sequence[np.ndarray]) -> Residuals:
    """Return what the residuals of an output, present or not in each log, say."""
    products, pairs = 0.0, 0
    for r, known in zip(whitened, present, strict=True):
        both = known[1:] & known[:-1]
        products += float((r[1:] * r[:-1])[both].sum())
        pairs += int(both.sum())
    values = np.concatenate([r[known] for r, known in zip(whitened, present, strict=True)])
    if not len(values):
        return Residuals(np.nan, np.nan, 0.0, 1.0)
    squares, outliers, usual = float(values @ values), outliers_of(values), robust_std(values)
    ratio = float(np.sqrt(squares / len(values)))
    serial = products / pairs * len(values) / squares if pairs > 2 and squares else np.nan
    far = outliers.share if outliers.chance < _CHANCE else 0.0
    return Residuals(ratio, serial, far, ratio / usual if usual > 0 else 1.0)


def whitened_innovations(y: np.ndarray, e: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Return innovations (num_samples, ny) in standard deviations, independent of each other.

    Args:
        y: outputs, shape (num_samples, ny); NaN marks a missing one.
        e: innovations, of the same shape, zero where there is none.
        S: their covariances, shape (num_samples, ny, ny).
    """
    present = ~np.isnan(y)
    own = np.where(present[:, :, None] & present[:, None], S, np.eye(y.shape[1]))
    L = cholesky(np.ascontiguousarray(own.transpose(1, 2, 0))).transpose(2, 0, 1)
    return np.linalg.solve(L, e[..., None])[..., 0]
