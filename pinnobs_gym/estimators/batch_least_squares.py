"""Least-squares estimation of the initial state from the whole record."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.estimation.gaussian import checked
from pinnobs_gym.estimation.least_squares import Fit, linearised, root, solved
from pinnobs_gym.estimation.projection import multipliers
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.estimation.wrapping import say_of_start
from pinnobs_gym.simulation.matrices import identity, inner, mapped, sandwich
from pinnobs_gym.simulation.record import Record

_ROUNDING = 1e-12
"""Largest relative increase of the cost that counts as none, so that rounding errors do not decide
on the last step."""


@dataclass(frozen=True)
class BatchLeastSquares(OfflineEstimator):
    """The model's trajectory that fits all outputs of a record and the prior best.

    The cost (x₀ − x̂₀)ᵀP₀⁻¹(x₀ − x̂₀) + Σ(y − h)ᵀR⁻¹(y − h) is minimised over x₀ by the
    Levenberg-Marquardt method (Nocedal & Wright 2006, section 10.3). The fit begins with a short
    initial part of the record, whose length is doubled until it is the whole record. The phase of
    an oscillation, known from the prior, is thus not lost. With an exact model the errors approach
    the Cramér–Rao bound. Covariances are those of the smoothed states, Φ(P₀⁻¹ + ΣΦᵀHᵀR⁻¹HΦ)⁻¹Φᵀ.

    If the states have bounds, x₀ is kept within them: a step that would leave them is that of the
    same quadratic cost with bounds (`pinnobs_gym.estimation.projection`).

    Default tuning is the same rule for all systems: P₀ is that of the prior, and R that of the
    known output noise.

    When to choose it: where a whole record is at hand, and the model is exact or nearly so: no
    other estimate of the trajectory is then as close. Where unknown forces act on the plant,
    `rts_smoother`.
    """

    max_iterations: int = 20
    """Largest number of iterations on the whole record."""
    first_iterations: int = 10
    """Largest number of iterations on each shorter part of the record."""
    shortest: int = 16
    """Largest number of samples in the first part of the record."""

    name = "batch_least_squares"
    exempt_from = {
        name: OfflineEstimator.exempt_from[name] for name in ("causality", "run_equals_updates")
    }
    takes = EVERYTHING - {"process_noise"}  # one initial state explains all samples
    equations = r"""
\hat x_{0|n} &= \arg\min_x \; (x - \hat x_0)^\top P_0^{-1} (x - \hat x_0)
+ \sum_{k=0}^{n} \bigl\| y_k - h(t_k, \varphi_k(x), u_k) \bigr\|^2_{R^{-1}} \\
\hat x_k &= \varphi_k(\hat x_{0|n}), \qquad \Phi_k = \tfrac{\partial \varphi_k}{\partial x} \\
P_k &= \Phi_k \Bigl( P_0^{-1} + \sum_j \Phi_j^\top H_j^\top R^{-1} H_j \Phi_j \Bigr)^{-1}
\Phi_k^\top
"""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("max_iterations", "first_iterations", "shortest"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}; expected at least 1")

    def run(self, record: Record) -> Estimates:
        # The parameters z, with x₀ = x̂₀ + Lz and LLᵀ = P₀, have a standard normal prior.
        record = replace(record, prior=checked(record.prior))
        say_of_start(self.label, self.system, record, self.noise.R(0.0))
        L = root(record.prior.cov.transpose(1, 2, 0))
        z = np.zeros(record.prior.mean.T.shape)
        z = self._inside(record.prior.mean, L, z, identity(*z.shape))
        with np.errstate(all="ignore"):
            for length in self._stretches(record.y):
                z = self._fitted(record, L, z, length)
            fit = self._evaluated(record, L, z, np.arange(record.batch), record.num_samples)
            # Map the covariance of z at the optimum to the states along the trajectory.
            cov = np.linalg.inv(fit.information.transpose(2, 0, 1)).transpose(1, 2, 0)
            P = np.stack([sandwich(X, cov) for X in fit.X])
        return Estimates(fit.x.swapaxes(0, 1), P.transpose(3, 0, 1, 2))

    def _stretches(self, y: np.ndarray) -> list[int]:
        """Return the lengths of the parts that are fitted, in rows of the record, whose outputs are
        y (batch, num_samples, ny). They are doubled in samples with outputs, so that rows without
        any change no step of the fit."""
        measured = np.flatnonzero(~np.isnan(y).all(axis=(0, 2)))
        counts = [len(measured)]
        while counts[0] > self.shortest:
            counts.insert(0, (counts[0] + 1) // 2)
        return [*(int(measured[count - 1]) + 1 for count in counts[:-1]), y.shape[1]]

    def _evaluated(
        self, record: Record, L: np.ndarray, z: np.ndarray, rows: np.ndarray, length: int
    ) -> Fit:
        """Return the fit at z (nx, rows) to the first samples of some of the records, including the
        prior."""
        root_of = L[..., rows]
        x0 = record.prior.mean[rows] + mapped(root_of, z.T)
        if (box := self.system.state_box) is not None:
            x0 = box.clipped(x0)  # against rounding
        y, u = record.y[rows, :length].swapaxes(0, 1), record.u[rows, :length].swapaxes(0, 1)
        t = record.t[:length]
        fit = linearised(self.system, self.noise.rows(rows), t, y, u, x0, root_of)
        information = fit.information + np.eye(len(z))[..., None]
        return Fit(fit.cost + inner(z, z), information, fit.right - z, fit.x, fit.X)

    def _fitted(self, record: Record, L: np.ndarray, z: np.ndarray, length: int) -> np.ndarray:
        """Return the z that minimise the cost over the first ``length`` samples, starting from the
        given z. A row is finished when the predicted decrease of its cost is negligible."""
        whole = length == record.num_samples
        least_gain = 1e-8 if whole else 1e-2  # a cost difference of 1 is one standard error
        z, rows = z.copy(), np.arange(record.batch)
        fit = self._evaluated(record, L, z, rows, length)
        cost, information, right = fit.cost, fit.information, fit.right
        damping = np.full(record.batch, 1e-4)
        for _ in range(self.max_iterations if whole else self.first_iterations):
            # The step solves the normal equations with a damped diagonal (Marquardt's scaling).
            diagonal = np.einsum("iib->ib", information)
            damped = information + damping * (np.eye(len(z))[..., None] * diagonal)
            trial = z[:, rows] + solved(damped, right)
            trial = self._inside(record.prior.mean[rows], L[..., rows], trial, damped)
            step = trial - z[:, rows]
            fit = self._evaluated(record, L, trial, rows, length)
            # Accept the step and reduce the damping where the cost does not increase; else increase
            # the damping.
            accepted = fit.cost <= (1 + _ROUNDING) * cost
            gain = inner(step, right)
            z[:, rows] = np.where(accepted, trial, z[:, rows])
            cost = np.where(accepted, fit.cost, cost)
            information = np.where(accepted, fit.information, information)
            right = np.where(accepted, fit.right, right)
            damping = np.where(accepted, damping / 10, damping * 10)
            # Continue with the rows that have not converged.
            active = (gain > least_gain) & (damping < 1e8)
            if not active.any():
                break
            rows, damping, cost = rows[active], damping[active], cost[active]
            information, right = information[..., active], right[:, active]
        return z

    def _inside(
        self, mean: np.ndarray, L: np.ndarray, z: np.ndarray, information: np.ndarray
    ) -> np.ndarray:
        """Return the parameters (nx, rows) within the bounds at which a quadratic cost with the
        minimum z and the Hessian ``information`` (nx, nx, rows), up to a factor, is least; mean
        (rows, nx) and L (nx, nx, rows) are those of the prior."""
        box, x0 = self.system.state_box, mean + mapped(L, z.T)
        if box is None:
            return z
        rows = np.flatnonzero(box.outside(x0) & np.isfinite(x0).all(axis=-1))
        if len(rows):
            # In x₀ the inverse of the Hessian is L·information⁻¹·Lᵀ.
            L_rows = L[..., rows].transpose(2, 0, 1)
            inverse = np.linalg.inv(information[..., rows].transpose(2, 0, 1))
            C = inverse @ L_rows.swapaxes(1, 2)
            force = multipliers(x0[rows], L_rows @ C, box)
            z = z.copy()
            z[:, rows] -= (C @ force[..., None])[..., 0].T
        return z
