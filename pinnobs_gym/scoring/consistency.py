"""Whether estimates are as good as their covariances say."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.simulation.matrices import squared_size

COVERAGE = 0.9
"""Probability of the intervals whose coverage is counted."""
_QUANTILE = NormalDist().inv_cdf((1 + COVERAGE) / 2)
"""How many standard deviations they reach to each side."""


def consistency(
    x: np.ndarray, estimates: Estimates, missing: np.ndarray
) -> dict[str, np.ndarray | None]:
    """How far errors and innovations are from what their covariances say, episode by episode
    (Bar-Shalom, Li & Kirubarajan 2001, section 5.4).

    The error is that of x̂(k|k) and needs P(k|k) alone, so that filters and smoothers are told
    alike. Innovations are the estimator's own, y − h(t, x̂(k|k−1), u) and its S: from x̂(k|k) and
    P(k|k) they could be had only with its own Q and gain. Of an estimator that does not give them,
    they are not known.

    Args:
        x: true states, shape (batch, num_samples, nx).
        estimates: of an estimator.
        missing: which outputs were missing, bool (batch, num_samples, ny).

    Returns:
        Arrays (batch,) by name, None where the estimator does not say enough; infinite where its
        numbers are not finite or not covariances:

        - ``anees``: mean over samples of (x̂ − x)ᵀP⁻¹(x̂ − x)/nx; 1 if P is right, larger if it is
          too small. `band` says within what the mean over episodes should be.
        - ``coverage``: which part of the errors, over samples and states, is within the central
          90 % interval of its variance.
        - ``nis``: mean over samples of the normalised innovation squared, over the number of
          outputs; 1 if S is right. Not a number if all outputs are missing.
        - ``innovation_correlation``: of the innovations over √S_ii with the next sample's; 0 if
          they are white. Not a number if there are no two to compare.
    """
    scores: dict[str, np.ndarray | None]
    scores = dict.fromkeys(("anees", "coverage", "nis", "innovation_correlation"))
    with np.errstate(all="ignore"):  # what is not finite is infinite in the scores
        if estimates.P is not None:
            error, variance = estimates.xhat - x, np.einsum("bkii->bki", estimates.P)
            size = _squared_sizes(error, estimates.P)
            scores["anees"] = size.mean(axis=1) / x.shape[-1]
            inside = abs(error) <= _QUANTILE * np.sqrt(variance)
            scores["coverage"] = inside.mean(axis=(1, 2))
        if estimates.innovation is not None and estimates.S is not None:
            innovation = np.where(missing, 0.0, estimates.innovation)
            number = (~missing).sum(axis=(1, 2))
            size = _squared_sizes(innovation, estimates.S)
            scores["nis"] = np.where(number > 0, size.sum(axis=1) / number, np.nan)
            std = np.sqrt(np.einsum("bkii->bki", estimates.S))
            scores["innovation_correlation"] = _lagged(innovation / std)
    return scores


def band(episodes: int, degrees: int, confidence: float = 0.95) -> tuple[float, float]:
    """Within what the mean of ``anees`` (degrees nx) over episodes is with at least this
    probability, if errors are Gaussian and covariances right: χ²/(episodes·degrees) of as many
    degrees of freedom. That of one sample is this wide; samples of one episode are taken as wholly
    dependent, because of plants without process noise they nearly are."""
    from scipy.special import gammaincinv

    count = episodes * degrees
    low, high = 2 * gammaincinv(count / 2, [(1 - confidence) / 2, (1 + confidence) / 2]) / count
    return float(low), float(high)


def _squared_sizes(vectors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """vᵀC⁻¹v of v (batch, num_samples, n), shape (batch, num_samples); infinite where C is not
    positive definite."""
    n = vectors.shape[-1]
    matrices = np.ascontiguousarray(covariances.reshape(-1, n, n).transpose(1, 2, 0))
    sizes = squared_size(vectors.reshape(-1, n), matrices)
    bad = ~(sizes >= 0) | ~(np.einsum("iib->ib", matrices) > 0).all(axis=0)
    return np.where(bad, np.inf, sizes).reshape(vectors.shape[:2])


def _lagged(values: np.ndarray) -> np.ndarray:
    """Correlation (batch,) of values (batch, num_samples, n) of mean zero with those one sample
    later; infinite where they are not finite, not a number where all are zero."""
    now, later = values[:, :-1], values[:, 1:]
    product = np.einsum("bki,bki->b", now, later)
    size = np.sqrt(np.einsum("bki,bki->b", now, now) * np.einsum("bki,bki->b", later, later))
    return np.where(np.isfinite(product), product / size, np.inf)
