"""Consistency of estimates and innovations with their covariances."""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.simulation.matrices import squared_size

COVERAGE = 0.9
"""Probability of the intervals whose coverage is scored."""
_QUANTILE = NormalDist().inv_cdf((1 + COVERAGE) / 2)
"""Half width of these intervals in standard deviations."""


def consistency(
    x: np.ndarray, estimates: Estimates, missing: np.ndarray
) -> dict[str, np.ndarray | None]:
    """Compare errors and innovations with their covariances, for each episode (Bar-Shalom, Li &
    Kirubarajan 2001, section 5.4).

    The error is that of x̂(k|k) and needs only P(k|k), so filters and smoothers are treated alike.
    Innovations are the estimator's own, y − h(t, x̂(k|k−1), u), with their covariance S; they
    cannot be reconstructed from x̂(k|k) and P(k|k) without the estimator's Q and gain. Their scores
    are None for an estimator that does not report them.

    Args:
        x: true states, shape (batch, num_samples, nx).
        estimates: of an estimator.
        missing: which outputs were missing, bool (batch, num_samples, ny).

    Returns:
        Arrays (batch,) by name, None where the estimator does not report the covariances; infinite
        where its numbers are not finite or not covariances:

        - ``anees``: mean over samples of (x̂ − x)ᵀP⁻¹(x̂ − x)/nx; 1 if P is right, larger if it is
          too small. `band` is the interval for the mean over episodes.
        - ``coverage``: fraction of the errors, over samples and states, within the central 90 %
          interval of their variance.
        - ``nis``: mean of the normalised innovation squared per output; 1 if S is right. NaN if all
          outputs are missing.
        - ``innovation_correlation``: correlation of the innovations over √S_ii with those of the
          next sample; 0 if they are white. NaN if no two can be compared.
    """
    scores: dict[str, np.ndarray | None]
    scores = dict.fromkeys(("anees", "coverage", "nis", "innovation_correlation"))
    with np.errstate(all="ignore"):  # scores are infinite where the numbers are not finite
        if estimates.P is not None:
            # Normalised estimation error squared, and coverage of each state's interval.
            error, variance = estimates.xhat - x, np.einsum("bkii->bki", estimates.P)
            size = _normalised_squares(error, estimates.P)
            scores["anees"] = size.mean(axis=1) / x.shape[-1]
            inside = abs(error) <= _QUANTILE * np.sqrt(variance)
            scores["coverage"] = inside.mean(axis=(1, 2))
        if estimates.innovation is not None and estimates.S is not None:
            # Missing outputs have innovation zero and are not counted.
            innovation = np.where(missing, 0.0, estimates.innovation)
            number = (~missing).sum(axis=(1, 2))
            size = _normalised_squares(innovation, estimates.S)
            scores["nis"] = np.where(number > 0, size.sum(axis=1) / number, np.nan)
            std = np.sqrt(np.einsum("bkii->bki", estimates.S))
            scores["innovation_correlation"] = _lag_one_correlation(innovation / std)
    return scores


def band(episodes: int, degrees: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval that contains the mean of ``anees`` (degrees nx) over episodes with at
    least this probability, if errors are Gaussian and covariances right: the central interval of
    χ²/n with n = episodes·degrees degrees of freedom.

    This is exact for one sample per episode. The samples of an episode count as fully dependent,
    which they nearly are for plants without process noise.
    """
    from scipy.special import gammaincinv

    count = episodes * degrees
    low, high = 2 * gammaincinv(count / 2, [(1 - confidence) / 2, (1 + confidence) / 2]) / count
    return float(low), float(high)


def _normalised_squares(vectors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Return vᵀC⁻¹v, shape (batch, num_samples), of v (batch, num_samples, n); infinite where C is
    not positive definite."""
    n = vectors.shape[-1]
    matrices = np.ascontiguousarray(covariances.reshape(-1, n, n).transpose(1, 2, 0))
    sizes = squared_size(vectors.reshape(-1, n), matrices)
    bad = ~(sizes >= 0) | ~(np.einsum("iib->ib", matrices) > 0).all(axis=0)
    return np.where(bad, np.inf, sizes).reshape(vectors.shape[:2])


def _lag_one_correlation(values: np.ndarray) -> np.ndarray:
    """Return the correlation (batch,) of zero-mean values (batch, num_samples, n) with those one
    sample later; infinite where they are not finite, NaN where all are zero."""
    values = np.ascontiguousarray(values)  # the order of a sum depends on the order in memory
    now, later = values[:, :-1], values[:, 1:]
    product = np.einsum("bki,bki->b", now, later)
    size = np.sqrt(np.einsum("bki,bki->b", now, now) * np.einsum("bki,bki->b", later, later))
    return np.where(np.isfinite(product), product / size, np.inf)
