"""Outputs of which some are outliers: the law of their noise, and what it does to an update."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.simulation.matrices import cholesky, squared_size, total


@dataclass(frozen=True)
class OutlierLaw:
    """Output noise that is larger in some outputs: of variance R in most, of size²·R in outliers.

    With the innovation of an output as a mixture of two Gaussian laws, of variances S = HPHᵀ + R
    and HPHᵀ + size²R, the gain of its update is the mean of the gains of both, weighted by their
    posterior probabilities (the collapse of a Gaussian sum, Alspach & Sorenson 1972; Bar-Shalom, Li
    & Kirubarajan 2001, section 11.6). It is the gain of an update with a larger R, which is used.
    """

    rate: float
    """Probability of an outlier, between 0 and 1."""
    size: float
    """Standard deviation of an outlier, in those of the output noise, above 1."""

    def __post_init__(self) -> None:
        if not 0 < self.rate < 1:
            raise ValueError(f"outliers={self.rate}; expected a probability between 0 and 1")
        if not 1 < self.size < np.inf:
            raise ValueError(f"outlier_size={self.size}; expected a number above 1")

    def inflated(self, innovation: np.ndarray, S: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Return the covariance of the output noise with which a sample is used, (ny, ny, batch):
        the variance of each output is multiplied by a factor of at least 1, and correlations stay.

        Args:
            innovation: y − ŷ, shape (ny, batch); zero where y is missing.
            S: covariances of the innovations, shape (ny, ny, batch).
            R: covariance of the output noise, shape (ny, ny, batch or 1).
        """
        factor = self.factors(innovation, _variances(S), _variances(R))
        return R * np.sqrt(factor[:, None] * factor)

    def factors(self, innovation: np.ndarray, own: np.ndarray, noise: np.ndarray) -> np.ndarray:
        """Return the factors, at least 1, of the variances of the output noise, shape (ny, ...).

        Args:
            innovation: y − ŷ, shape (ny, ...); zero where y is missing.
            own: variances of the innovations, same shape.
            noise: variances of the output noise, same shape or one that it can be repeated to.
        """
        wide = own + (self.size**2 - 1) * noise
        probability = self._probability(innovation, own, wide)
        mean_inverse = (1 - probability) / own + probability / wide
        return np.maximum((1 / mean_inverse - own) / noise + 1, 1)

    def _probability(self, innovation: np.ndarray, own: np.ndarray, wide: np.ndarray) -> np.ndarray:
        """Return the posterior probabilities of outliers, given the variances of the innovations
        without and with one, all of shape (ny, batch)."""
        odds = math.log(1 / self.rate - 1) + np.log(wide / own) / 2
        odds = odds - innovation**2 * (1 / own - 1 / wide) / 2
        return 1 / (1 + np.exp(odds))


def log_density(
    innovation: np.ndarray,
    S: np.ndarray,
    R: np.ndarray,
    missing: np.ndarray,
    rate: np.ndarray | float,
    size: float,
) -> np.ndarray:
    """Return the logarithm of the density of innovations, shape (batch,); 0 without any output.

    Each output has the density of the mixture of `OutlierLaw`. Correlations between outputs count
    as far as neither is an outlier.

    Args:
        innovation: y − ŷ, shape (ny, batch); zero where y is missing.
        S: covariances of the innovations, shape (ny, ny, batch).
        R: covariance of the output noise, shape (ny, ny, batch or 1).
        missing: which outputs are missing, bool, shape (ny, batch).
        rate: probability of an outlier, a number or shape (batch,); 0 for none.
        size: standard deviation of an outlier, in those of the output noise.
    """
    own = _variances(S)
    wide = own + (size**2 - 1) * _variances(R)
    usual = np.log1p(-rate) + _log_normal(innovation, own)
    large = np.log(rate) + _log_normal(innovation, wide)
    density = np.where(missing, 0.0, np.logaddexp(usual, large)).sum(axis=0)
    if len(innovation) == 1:
        return density
    # What correlations add to the sum of the outputs' own, from the matrix of correlations
    e = np.where(missing, 0.0, innovation / np.sqrt(own))
    both = ~(missing[:, None] | missing)
    C = np.where(both, S / np.sqrt(own[:, None] * own), 0.0)
    C[range(len(e)), range(len(e))] = 1.0
    pivots = _variances(cholesky(C))
    joint = (total(e**2) - squared_size(e.T, C)) / 2 - total(np.log(pivots))
    usually = np.exp(usual - np.logaddexp(usual, large))
    return density + np.where(missing, 1.0, usually).prod(axis=0) * joint


def _variances(S: np.ndarray) -> np.ndarray:
    return np.einsum("iib->ib", S)


def _log_normal(innovation: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return the logarithm of the normal density of each innovation."""
    return -(innovation**2 / variance + np.log(2 * math.pi * variance)) / 2
