"""Kernels that keep the particles of a set apart after resampling (Liu & West 2001), where process
noise is too small to do so."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.square_root import root_of, substituted
from pinnobs_gym.simulation.matrices import cholesky
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System

_DISCOUNT = 0.95
"""Liu and West's δ where kernels are needed after resampling."""
_TEMPERED = 0.7
"""Their δ in tempering without process noise. Wide kernels keep the covariance of the set right
over many resamplings, even where the outputs are four standard deviations from the prior."""


@dataclass(frozen=True, eq=False)
class Sample:
    """What particles are weighed by, and what moved them since the sample before."""

    t: float
    """Time in s."""
    y: np.ndarray
    """Outputs, shape (batch, ny); NaN marks a missing output."""
    u: np.ndarray
    """Inputs, shape (batch, nu)."""
    R: np.ndarray
    """Covariance of the output noise, shape (ny, ny, batch or 1)."""
    Q: np.ndarray
    """Covariance that process noise has given particles since the sample before, to first order,
    shape (nx, nx, batch or 1); zero at the first sample."""

    @staticmethod
    def of(noise: Noise, before: float | None, t: float, y: np.ndarray, u: np.ndarray) -> Sample:
        """Return the sample at time t (s), given the time of the sample before; None if there is
        none."""
        L = noise.L(t)
        Q = np.zeros((len(L), len(L), 1))
        if before is not None and L.shape[1]:
            Q = (t - before) * noise.root(t).density
        return Sample(t, y, u, noise.R(t, y), Q)

    def rows(self, rows: np.ndarray) -> Sample:
        """Return the sample of some rows of the batch."""
        R, Q = (part[..., rows] if part.shape[2] > 1 else part for part in (self.R, self.Q))
        return replace(self, y=self.y[rows], u=self.u[rows], R=R, Q=Q)


def shrinkage_of(discount: float) -> float:
    """Return Liu and West's a = (3δ − 1)/2δ, with which centres of kernels are shrunk towards the
    mean; the kernels have the share 1 − a² of the set's variance."""
    return (3 * discount - 1) / (2 * discount)


def usual_shrinkage(*, tempering: bool) -> float:
    """Return the a of `shrinkages` without process noise."""
    return shrinkage_of(_TEMPERED if tempering else _DISCOUNT)


def shrinkages(
    system: System, sample: Sample, mean: np.ndarray, P: np.ndarray, *, tempering: bool
) -> np.ndarray:
    """Return a (batch,) of kernels that make up for what process noise lacks; 1 for none.

    Let q be the least share, of all directions, of the variance of what is known locally that
    process noise adds in a step: the least eigenvalue of Q relative to (P⁻¹ + HᵀR⁻¹H)⁻¹, which is
    the width of a mode where the particles have several. With κ(δ) = 1 − a², kernels have the share
    max(0, κ(0.95) − q) after resampling. After a tempering step they have the share
    max(κ(0.95), κ(0.7)(1 − q/κ(0.95))), because wide ones would join modes that process noise
    leaves apart.

    Args:
        system: the model.
        sample: the sample.
        mean: mean of the particles, shape (batch, nx).
        P: their covariances, shape (batch, nx, nx).
        tempering: whether a tempering step precedes.
    """
    q, (a, wide) = _renewed(system, sample, mean, P), map(shrinkage_of, (_DISCOUNT, _TEMPERED))
    usual = 1 - a**2
    if tempering:
        share, a = np.maximum((1 - wide**2) * (1 - q / usual), usual), wide
    else:
        share = np.maximum(usual - q, 0.0)
    return np.where(q > 0, np.sqrt(1 - share), a)


def _renewed(system: System, sample: Sample, mean: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Return the q of `shrinkages`, zero where it is not finite."""
    if not sample.Q.any():
        return np.zeros(len(P))
    # Contiguous, so that sums are formed in one order in any batch.
    L = np.ascontiguousarray(cholesky(P.transpose(1, 2, 0), semidefinite=True).transpose(2, 0, 1))
    H = np.where(np.isnan(sample.y)[..., None], 0.0, system.h_jacobian(sample.t, mean, sample.u))
    R, Q = (part.transpose(2, 0, 1) for part in (sample.R, sample.Q))
    noise = root_of(np.broadcast_to(R, (len(P), *R.shape[1:])))
    G = substituted(noise, H @ L)
    # With P = LLᵀ and I + GᵀG = CCᵀ, the local covariance is LC⁻ᵀ(LC⁻ᵀ)ᵀ.
    inner = np.eye(L.shape[1]) + G.swapaxes(1, 2) @ G
    half = substituted(L, np.broadcast_to(Q, L.shape))
    whitened = substituted(L, half.swapaxes(1, 2))
    finite = np.isfinite(inner).all(axis=(1, 2)) & np.isfinite(whitened).all(axis=(1, 2))
    q = np.zeros(len(P))
    if finite.any():
        C = np.linalg.cholesky(inner[finite])
        q[finite] = np.linalg.eigvalsh(C.swapaxes(1, 2) @ whitened[finite] @ C)[:, 0]
    return np.maximum(q, 0.0)
