"""The extended Rauch-Tung-Striebel smoother."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator, State
from pinnobs_gym.estimation.gaussian import (
    GaussianEstimator,
    checked,
    corrected,
    covariances,
    predicted,
)
from pinnobs_gym.estimation.kalman import observe
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.estimation.linear_window import linear_window, smoothed, whitened
from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.estimation.smoother import backward, forward, ill_conditioned
from pinnobs_gym.estimation.square_root import carried, prior_root
from pinnobs_gym.estimation.wrapping import say_of_start
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record


@dataclass(frozen=True)
class RTSSmoother(OfflineEstimator, GaussianEstimator):
    """The extended Kalman filter, followed by the backward recursion of Rauch, Tung and Striebel,
    which estimates each state from all outputs (Särkkä 2013, section 9.1).

    The smoother uses the filter's linearisation. Where the filter converges to a wrong trajectory,
    the smoother does, too.

    With little process noise, known or assumed, or none, P⁻ of a contracting plant becomes nearly
    singular, and the inverse in the recursion loses digits; with a very wide prior, covariances do.
    In these cases the same estimates are computed by two filters that carry roots, without an
    inverse (`pinnobs_gym.estimation.linear_window`).

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.
    """

    name = "rts_smoother"
    exempt_from = {
        name: OfflineEstimator.exempt_from[name] for name in ("causality", "run_equals_updates")
    }
    equations = r"""
C_k &= P_k F_k^\top (P_{k+1}^-)^{-1} \\
\hat x_k^s &= \hat x_k + C_k (\hat x_{k+1}^s - \hat x_{k+1}^-) \\
P_k^s &= (I - C_k F_k)\, P_k (I - C_k F_k)^\top + C_k (P_{k+1}^s + Q)\, C_k^\top
"""

    def run(self, record: Record) -> Estimates:
        record = replace(record, prior=checked(record.prior))
        R = self.noise.R(0.0)
        say_of_start(self.label, self.system, record, R)
        roots = prior_root(self.system, record.prior, R)
        rows = np.arange(0) if roots is None else carried(roots)
        # A noise of one's own that differs between rows is that of all rows, not of some.
        by_row = self.noise.samples is None and R.shape[-1] > 1
        if not self.noise.stochastic or (len(rows) and by_row):
            rows = np.arange(record.batch)
        with np.errstate(all="ignore"):  # diverged rows are marked by their non-finite values
            if len(rows) == record.batch:
                return self._by_roots(record, self.noise)
            filtered = forward(self.system, record, self.noise)
            near = ill_conditioned(filtered)
            rows = np.union1d(rows, near)
            if len(rows) == record.batch or (len(near) and by_row):
                return self._by_roots(record, self.noise)
            path = backward(filtered)
            xhat, P = path.xhat.swapaxes(0, 1), path.P.transpose(3, 0, 1, 2)
            if len(rows):
                wide = self._by_roots(record.rows(rows), self.noise.rows(rows))
                xhat, P = xhat.copy(), P.copy()
                xhat[rows], P[rows] = wide.xhat, wide.P
        return Estimates(xhat, P)

    def _by_roots(self, record: Record, noise: Noise) -> Estimates:
        """Return the estimates, computed by roots in all rows."""
        t, y, u = record.t, record.y.swapaxes(0, 1), record.u.swapaxes(0, 1)
        system = self.system
        roots = root(record.prior.cov.transpose(1, 2, 0)).transpose(2, 0, 1)
        before, after = self._filtered(record, roots, noise)
        window = linear_window(self.system, noise, t.tolist(), list(y), list(u), after)
        # The filter linearises h about its predictions, not its estimates.
        for k in range(len(t)):
            e, H = whitened(self.system, noise, (float(t[k]), y[k], u[k]), before[k])
            moved = (system.state_residual(after[k], before[k])[:, None] @ H.swapaxes(1, 2))[:, 0]
            window.e[k], window.H[k] = e - moved, H
        first = system.state_residual(record.prior.mean, window.r[0])
        states = smoothed(window, first, roots)
        P = states.root @ states.root.swapaxes(-1, -2)
        return Estimates(states.x.swapaxes(0, 1), P.swapaxes(0, 1))

    def _filtered(
        self, record: Record, roots: np.ndarray, noise: Noise
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the predictions and the estimates (num_samples, batch, nx) of the extended Kalman
        filter, by roots of the covariances, given those of the prior (batch, nx, nx)."""
        system, box = self.system, self.system.state_box
        state, before, after = State(record.prior.mean, P=record.prior.cov, root=roots), [], []
        for k, t in enumerate(record.t):
            y, u = record.y[:, k], record.u[:, k]
            if k:
                state = predicted(system, state, covariances(state), noise, float(t), u)
            innovation, H = observe(system, float(t), state.xhat, y, u)
            before.append(state.xhat)
            P, R = covariances(state), noise.R(float(t), y)
            state = corrected(state, (float(t), u), P, innovation, H, R)
            state = state if box is None else kept_inside(state, box)
            after.append(state.xhat)
        return np.stack(before), np.stack(after)
