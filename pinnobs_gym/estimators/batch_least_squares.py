"""Least squares over the initial state, on the whole record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.estimation.gaussian import checked
from pinnobs_gym.estimation.least_squares import Fit, linearised, root, solved
from pinnobs_gym.simulation.matrices import sandwich
from pinnobs_gym.simulation.record import Record


@dataclass(frozen=True)
class BatchLeastSquares(OfflineEstimator):
    """The model's trajectory nearest to all outputs of a record and to the prior.

    It minimises (x₀ − x̂₀)ᵀP₀⁻¹(x₀ − x̂₀) + Σ(y − h)ᵀR⁻¹(y − h) over x₀ by Levenberg and
    Marquardt's method (Nocedal & Wright 2006, section 10.3), first over the beginning of the record
    and then over stretches of twice the length, so that it follows an oscillation from the phase
    that the prior knows. Where the model is exact this attains the Cramér–Rao bound. Covariances
    are those of the smoothed states, Φ(P₀⁻¹ + ΣΦᵀHᵀR⁻¹HΦ)⁻¹Φᵀ.

    Default tuning, the same rule for all systems: P₀ from the prior, R from the noise level it is
    given (`BaseEstimator.output_variance`).
    """

    max_iterations: int = 20
    """Most evaluations of a record's trajectory over the whole of it."""
    first_iterations: int = 10
    """The same over each of the stretches before."""
    shortest: int = 16
    """Samples of the first stretch."""

    name = "batch_least_squares"
    exempt_from = {
        name: OfflineEstimator.exempt_from[name] for name in ("causality", "run_equals_updates")
    }
    equations = r"""
\hat x_{0|n} &= \arg\min_x \; (x - \hat x_0)^\top P_0^{-1} (x - \hat x_0)
+ \sum_{k=0}^{n} \bigl\| y_k - h(t_k, \varphi_k(x), u_k) \bigr\|^2_{R^{-1}} \\
\hat x_k &= \varphi_k(\hat x_{0|n}), \qquad \Phi_k = \tfrac{\partial \varphi_k}{\partial x} \\
P_k &= \Phi_k \Bigl( P_0^{-1} + \sum_j \Phi_j^\top H_j^\top R^{-1} H_j \Phi_j \Bigr)^{-1}
\Phi_k^\top
"""

    def __post_init__(self) -> None:
        for name in ("max_iterations", "first_iterations", "shortest"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}; expected at least 1")

    def run(self, record: Record) -> Estimates:
        # The parameters are z with x₀ = x̂₀ + Lz, LLᵀ = P₀: standard normal by the prior.
        record = replace(record, prior=checked(record.prior))
        L = root(record.prior.cov.transpose(1, 2, 0))
        z = np.zeros(record.prior.mean.T.shape)
        with np.errstate(all="ignore"):
            for length in self._stretches(record.num_samples):
                z = self._fitted(record, L, z, length)
            fit = self._evaluated(record, L, z, np.arange(record.batch), record.num_samples)
            cov = np.linalg.inv(fit.information.transpose(2, 0, 1)).transpose(1, 2, 0)
            P = np.stack([sandwich(X, cov) for X in fit.X])
        return Estimates(fit.x.swapaxes(0, 1), P.transpose(3, 0, 1, 2))

    def _stretches(self, num_samples: int) -> list[int]:
        lengths = [num_samples]
        while lengths[0] > self.shortest:
            lengths.insert(0, (lengths[0] + 1) // 2)
        return lengths

    def _evaluated(
        self, record: Record, L: np.ndarray, z: np.ndarray, rows: np.ndarray, length: int
    ) -> Fit:
        """The fit at z (nx, rows) over the beginning of some of the records, prior included."""
        root_of = L[..., rows]
        x0 = record.prior.mean[rows] + np.einsum("ijb,jb->bi", root_of, z)
        y, u = record.y[rows, :length].swapaxes(0, 1), record.u[rows, :length].swapaxes(0, 1)
        R = self.output_variance
        fit = linearised(self.system, record.t[:length], y, u, x0, root_of, R)
        information = fit.information + np.eye(len(z))[..., None]
        return Fit(fit.cost + (z**2).sum(axis=0), information, fit.right - z, fit.x, fit.X)

    def _fitted(self, record: Record, L: np.ndarray, z: np.ndarray, length: int) -> np.ndarray:
        """The best z, from z on; a row is done when its next step would gain next to nothing."""
        whole = length == record.num_samples
        least_gain = 1e-8 if whole else 1e-2  # in units of cost, of which one is a standard error
        z, rows = z.copy(), np.arange(record.batch)
        fit = self._evaluated(record, L, z, rows, length)
        cost, information, right = fit.cost, fit.information, fit.right
        damping = np.full(record.batch, 1e-4)
        for _ in range(self.max_iterations if whole else self.first_iterations):
            diagonal = np.einsum("iib->ib", information)
            step = solved(information + damping * (np.eye(len(z))[..., None] * diagonal), right)
            trial = z[:, rows] + step
            fit = self._evaluated(record, L, trial, rows, length)
            better = fit.cost < cost
            gain = (step * right).sum(axis=0)
            z[:, rows] = np.where(better, trial, z[:, rows])
            cost = np.where(better, fit.cost, cost)
            information = np.where(better, fit.information, information)
            right = np.where(better, fit.right, right)
            damping = np.where(better, damping / 10, damping * 10)
            going = (gain > least_gain) & (damping < 1e8)
            if not going.any():
                break
            rows, damping, cost = rows[going], damping[going], cost[going]
            information, right = information[..., going], right[:, going]
        return z
