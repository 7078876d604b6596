"""Which states the outputs of a log tell nothing of, by the covariances of its estimates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.logs.normalised import told_noise
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System, vector

_FELL = 0.99
"""Variance, over that of the prior, below which the outputs have told something."""
_KEPT = 0.9
"""Part of an error at the start, in prior standard deviations, that a filter keeps if it does not
see the state."""
_LONGEST = 2000
"""Largest number of samples along which such an error is followed."""
_OPEN = 0.1
"""Standard deviation at the end, over a state's scale, from which on it matters."""


@dataclass(frozen=True)
class Seen:
    """What the covariances of a log's estimates say of each state."""

    left: np.ndarray
    """Least standard deviation over that of the prior, shape (nx,); NaN if the prior has none."""
    unseen: np.ndarray
    """Whether the outputs told nothing of the state, bool (nx,)."""
    matters: np.ndarray
    """Whether it is unseen and uncertain at the end, compared with its scale, bool (nx,)."""


def seen(system: System, setup: Setup, record: Record, estimates: Estimates) -> Seen | None:
    """Return which states the outputs tell, None for estimates without covariances.

    A state whose variance falls below that of the prior is seen. Of the others, process noise may
    drive one whose prior is narrower than what outputs tell of it later. An error at the start then
    dies out, since the filter forgets it by x̃ := (I − KH)Fx̃, whereas nothing corrects the error
    of a state that is not seen.
    """
    if estimates.P is None:
        return None
    variance = np.einsum("kii->ki", estimates.P[0])
    before = np.diagonal(record.prior.cov[0])
    with np.errstate(all="ignore"):
        left = np.sqrt(np.maximum(variance.min(axis=0), 0) / before)
    unseen = (left**2 > _FELL) & (before > 0)
    if unseen.any():
        unseen &= _kept(system, setup, record, estimates.xhat[0], estimates.P[0]) > _KEPT
    wide = np.sqrt(variance[-1]) > _OPEN * vector(system.scale, system.nx, "scale")
    return Seen(left, unseen, unseen & wide)


def _kept(
    system: System, setup: Setup, record: Record, xhat: np.ndarray, P: np.ndarray
) -> np.ndarray:
    """Return what is left of an error at the start in each state (nx,), in standard deviations of
    the prior: the norms of the rows of Ψ = Π(I − KH)F over the first samples, with K = PHᵀR⁻¹ of an
    optimal filter (Jazwinski 1970, section 7.3), along the estimates xhat (num_samples, nx) with
    covariances P (num_samples, nx, nx)."""
    noise = told_noise(system, setup, record)
    t, y, u = record.t, record.y[0], record.u[0]
    std = np.sqrt(np.diagonal(record.prior.cov[0]))
    kept = np.diag(std)
    with np.errstate(all="ignore"):
        for k in range(min(record.num_samples, _LONGEST)):
            if k:
                before, now = slice(k - 1, k), slice(k, k + 1)
                _, F = model_step_jacobian(
                    system, float(t[k - 1]), float(t[k]), xhat[before], u[before], u[now]
                )
                kept = F[0] @ kept
            present = ~np.isnan(y[k])
            if present.any():
                H = np.asarray(system.h_jacobian(t[k], xhat[k : k + 1], u[k : k + 1]))[0, present]
                R = noise.R(float(t[k]))[..., 0][np.ix_(present, present)]
                kept = kept - P[k] @ H.T @ np.linalg.solve(R, H @ kept)
        return np.linalg.norm(kept, axis=1) / std
