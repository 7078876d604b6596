"""What speaks against the estimates of a record without known states, such as a sensor log."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector

_FAR = 1e3
"""Distance of an estimate from the prior's mean, in scales, from which on it counts as diverged."""
_USUAL = (0.5, 2.0)
"""Range of the median normalised innovation squared, relative to its expectation."""
_CHANCE = 1e-4
"""Probability below which a median beyond that range is not taken for chance."""


def doubts(system: System, record: Record, estimates: Estimates) -> list[str]:
    """Return what speaks against the estimates of a record's first row, a line each.

    The normalised innovation squared (NIS) eᵀS⁻¹e of a sample with n outputs follows χ² with n
    degrees of freedom if the model and its noise are right (Bar-Shalom, Li & Kirubarajan 2001,
    section 5.4.2). Each sample's is divided by the median of its χ², of which the median over the
    samples is judged: it does not depend on the start or on a few outliers. Half of the samples are
    then expected below one, a number that is binomial.

    Args:
        system: the model.
        record: the samples.
        estimates: of an estimator; without innovations and their covariances they are only compared
            with the scale.
    """
    xhat = estimates.xhat[0]
    if not np.isfinite(xhat).all():
        return ["the estimates leave the finite numbers"]
    lines = []
    far = abs(xhat - record.prior.mean[0]) / vector(system.scale, system.nx, "scale")
    k, i = np.unravel_index(np.argmax(far), far.shape)
    if far[k, i] > _FAR:
        lines.append(
            f"{system.state_names[i]} is estimated as {xhat[k, i]:.6g}, {far[k, i]:.2g} times its "
            "scale away from the start; the estimator has probably diverged"
        )
    if (ratios := _nis_ratios(record, estimates)) is None or not len(ratios):
        return lines
    median, low = float(np.median(ratios)), _USUAL[0]
    if not low <= median <= _USUAL[1] and _chance(ratios) < _CHANCE:
        size, advice = ("large", "small") if median > 1 else ("small", "large")
        lines.append(
            f"the innovations are too {size} for their covariances, by a factor of {median:.2g} in "
            f"the median of their squares; the model does not explain this log, or its noise is "
            f"told too {advice}: the standard deviations cannot be trusted"
        )
    return lines


def _nis_ratios(record: Record, estimates: Estimates) -> np.ndarray | None:
    """Return the NIS of each sample of the first row that has outputs, over its median; None if the
    estimator reports no innovations, or covariances that are none."""
    from scipy.special import gammaincinv  # takes long to import

    if estimates.innovation is None or estimates.S is None:
        return None
    innovation, S = estimates.innovation[0], estimates.S[0]
    present = ~np.isnan(record.y[0])
    ratios = []
    for pattern in np.unique(present[present.any(axis=1)], axis=0):
        rows = (present == pattern).all(axis=1)
        e, own = innovation[rows][:, pattern], S[rows][:, pattern][:, :, pattern]
        try:
            squares = np.einsum("ki,ki->k", e, np.linalg.solve(own, e[..., None])[..., 0])
        except np.linalg.LinAlgError:
            return None
        ratios.append(squares / (2 * gammaincinv(pattern.sum() / 2, 0.5)))
    return np.concatenate([np.empty(0), *ratios])


def _chance(ratios: np.ndarray) -> float:
    """Return the probability that as many of the samples, or more, are on one side of their
    median."""
    from scipy.special import bdtr  # takes long to import

    fewer = min(int((ratios > 1).sum()), int((ratios <= 1).sum()))
    return min(1.0, 2 * float(bdtr(fewer, len(ratios), 0.5)))
