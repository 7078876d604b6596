"""Innovations of a log, or residuals of estimates without them, over their standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.simulation.noise import AssumedNoise, SampledLevel
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System

_SINGULAR = 1e-13
"""Least eigenvalue of a matrix of correlations below which it is taken for singular."""
_EARLY = 0.1
"""Least share of the samples that count as the start."""
_LATEST = 0.5
"""Largest share of them."""
_SETTLED = 2.0
"""Variance of an innovation, over its median in the second half, at which the start ends."""
_MOSTLY_NOISE = 0.5
"""Largest variance of an estimated output, over that of its noise, at which the residual still
tells how large the noise is."""


@dataclass(frozen=True, eq=False)
class Normalised:
    """What is judged of the first row of a record."""

    values: np.ndarray
    """Innovations, or residuals, over their standard deviations, shape (num_samples, ny): standard
    normal if the model is right; NaN where an output is missing."""
    squares: np.ndarray | None
    """Normalised innovation squared eᵀS⁻¹e of all outputs that a sample has, (num_samples,); None
    for residuals."""
    start: int
    """Number of samples at the start that do not count."""
    of_filter: bool
    """Whether these are innovations with covariances; otherwise residuals y − h(t, x̂, u)."""
    small_tells: np.ndarray
    """Whether values that are too small speak against the noise that is told, bool (ny,)."""
    white: np.ndarray
    """Whether values of a right model are uncorrelated, bool (ny,)."""


def normalised(system: System, setup: Setup, record: Record, estimates: Estimates) -> Normalised:
    """Return the normalised innovations, or, of estimates without innovation covariances, the
    residuals y − h(t, x̂, u) over the standard deviation of the noise.

    The estimate x̂ has used y. If it is optimal with covariance P, the residual has the covariance
    R − HPHᵀ (Särkkä 2013, section 4.3), which is at most R: residuals that are larger than the
    noise speak against the estimates. Smaller ones do so only if P is known and HPHᵀ is small.
    """
    if estimates.innovation is not None and estimates.S is not None:
        return _of_innovations(system, setup, record, estimates.innovation[0], estimates.S[0])
    return _of_residuals(system, setup, record, estimates)


def _of_innovations(
    system: System, setup: Setup, record: Record, innovation: np.ndarray, S: np.ndarray
) -> Normalised:
    variance = np.einsum("kii->ki", S)
    wrong = ~(np.isfinite(S).all(axis=(1, 2)) & (variance > 0).all(axis=1))
    absent = np.isnan(record.y[0]) | wrong[:, None]
    with np.errstate(all="ignore"):
        values = np.where(absent, np.nan, innovation / np.sqrt(variance))
    told = told_noise(system, setup, record)
    silent = np.einsum("iib->i", told.told.R(0.0)) == 0
    return Normalised(
        values,
        _normalised_squares(np.where(absent, 0.0, values), S, absent),
        _start(variance, absent),
        True,
        ~silent,  # a floor stands for the noise that is told as zero
        np.ones(system.ny, dtype=bool),
    )


def _normalised_squares(values: np.ndarray, S: np.ndarray, absent: np.ndarray) -> np.ndarray:
    """Return eᵀS⁻¹e of the outputs that each sample has; NaN where S is not positive definite."""
    with np.errstate(all="ignore"):
        std = np.sqrt(np.einsum("kii->ki", S))
        scaled = S / std[:, :, None] / std[:, None, :]
    # Without the rows and columns of absent outputs, whose values are zero.
    scaled = np.where(absent[:, :, None] | absent[:, None, :], np.eye(S.shape[-1]), scaled)
    regular = np.linalg.eigvalsh(scaled)[:, 0] > _SINGULAR
    scaled[~regular] = np.eye(S.shape[-1])
    squares = (values * np.linalg.solve(scaled, values[..., None])[..., 0]).sum(axis=1)
    return np.where(regular & ~absent.all(axis=1), squares, np.nan)


def _of_residuals(system: System, setup: Setup, record: Record, estimates: Estimates) -> Normalised:
    y, u, xhat = record.y[0], record.u[0], estimates.xhat[0]
    noise = told_noise(system, setup, record)
    times = record.t if record.noise_std is not None else record.t[:1]
    R = np.stack([np.einsum("iib->i", noise.R(float(t))) for t in times])
    silent = np.einsum("iib->i", noise.told.R(0.0)) == 0
    R = np.broadcast_to(R, y.shape)
    with np.errstate(all="ignore"):
        residual = system.output_residual(y, np.asarray(system.h(record.t, xhat, u)))
        clear, variance = np.zeros(system.ny, dtype=bool), R
        if estimates.P is not None:
            H = np.asarray(system.h_jacobian(record.t, xhat, u))
            taken = np.einsum("kij,kjl,kil->ki", H, estimates.P[0], H)
            clear = np.median(taken / R, axis=0) < _MOSTLY_NOISE
            variance = np.where(clear & (taken < _MOSTLY_NOISE * R), R - taken, R)
        values = residual / np.sqrt(variance)
    values = np.where(np.isfinite(values), values, np.nan)
    start = int(_EARLY * len(y))
    return Normalised(values, None, start, False, clear & ~silent, clear)


def told_noise(system: System, setup: Setup, record: Record) -> AssumedNoise:
    """Return the noise that a filter assumes, with levels by sample where the record has them."""
    level = setup.noise_std
    if record.noise_std is not None:
        level = SampledLevel(record.t, record.noise_std[:1], level)
    return AssumedNoise.of(system, system.noise(level, setup.process_noise))


def _start(variance: np.ndarray, absent: np.ndarray) -> int:
    """Return how many samples belong to the start, where a filter forgets a wide prior: until the
    variances (num_samples, ny) are near those of the second half, within limits."""
    number = len(variance)
    ends = [int(_EARLY * number)]
    for own, missing in zip(variance.T, absent.T, strict=True):
        present = np.flatnonzero(~missing)
        later = own[present[present >= number // 2]]
        if len(later):
            settled = present[own[present] <= _SETTLED * np.median(later)]
            ends.append(min(int(settled[0]), int(_LATEST * number)))
    return max(ends)
