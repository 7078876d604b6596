"""How well logs tell the unknowns of a fit, and whether the fit explains the logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.matrices import cholesky

_LOST = 1e-10
"""Eigenvalue of the scaled information below which the logs say nothing of a direction."""
_SHARE = 0.1
"""Share of an unknown in such a direction, squared, from which it is named."""


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


def residuals_of(whitened: Sequence[np.ndarray], y: Sequence[np.ndarray]) -> list[Residuals]:
    """Return what the residuals of each output say.

    Args:
        whitened: those of each log in standard deviations, independent of each other, shape
            (num_samples, ny).
        y: outputs, of the same shape; NaN marks a missing one.
    """
    found = []
    for j in range(y[0].shape[1]):
        squares, products, count, pairs = 0.0, 0.0, 0, 0
        for r, outputs in zip(whitened, y, strict=True):
            present = ~np.isnan(outputs[:, j])
            both = present[1:] & present[:-1]
            squares += float((r[present, j] ** 2).sum())
            products += float((r[1:, j] * r[:-1, j])[both].sum())
            count, pairs = count + int(present.sum()), pairs + int(both.sum())
        ratio = float(np.sqrt(squares / count)) if count else np.nan
        serial = products / pairs * count / squares if pairs > 2 and squares else np.nan
        found.append(Residuals(ratio, serial))
    return found


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
