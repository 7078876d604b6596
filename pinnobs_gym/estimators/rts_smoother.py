"""The extended Rauch-Tung-Striebel smoother."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from pinnobs_gym.estimation.compiled_code import of_rows
from pinnobs_gym.estimation.compiled_smoother import CompiledSmoother, compiled_smoother
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
from pinnobs_gym.estimation.smoother import Path, backward, forward, ill_conditioned
from pinnobs_gym.estimation.square_root import carried, prior_root
from pinnobs_gym.estimation.wrapping import say_of_start
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

    When to choose it: where a whole record is at hand and unknown forces act on the plant, or the
    record is long: it costs a few times as much as `ekf`. With an exact model,
    `batch_least_squares`.
    """

    template: ClassVar[str] = "smoother"
    """The template of `pinnobs_gym.simulation.kernels` that computes the same."""
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
        wide = np.arange(0) if roots is None else carried(roots)
        # A noise of one's own that differs between rows is that of all rows, not of some.
        by_row = self.noise.samples is None and R.shape[-1] > 1
        if not self.noise.stochastic or (len(wide) and by_row):
            wide = np.arange(record.batch)
        with np.errstate(all="ignore"):  # diverged rows are marked by their non-finite values
            if len(wide) == record.batch:
                return self._by_roots(record)
            estimates, near = self._by_recursion(record)
            rows = np.union1d(wide, near)
            if len(rows) == record.batch or (len(near) and by_row):
                return self._by_roots(record)
            if len(rows):
                part = of_rows(self, rows)._by_roots(record.rows(rows))
                _set_rows(estimates, rows, part)
        return estimates

    @cached_property
    def compiled(self) -> CompiledSmoother | None:
        """The compiled code of the smoother; None if it is computed in NumPy."""
        found = compiled_smoother(self)
        return None if isinstance(found, str) else found

    def ask_model(self) -> None:
        if self.compiled is None:  # the compiled smoother contains the model's steps
            super().ask_model()

    def _by_recursion(self, record: Record) -> tuple[Estimates, np.ndarray]:
        """Return the estimates, and the numbers of the rows in which they have lost digits."""
        found = None if self.compiled is None else self.compiled.run(record)
        if found is None:
            return self._by_numpy(record)
        estimates, left = found
        if len(left):
            part, near = of_rows(self, left)._by_numpy(record.rows(left))
            _set_rows(estimates, left, part)
            left = left[near]
        return estimates, left

    def _by_numpy(self, record: Record) -> tuple[Estimates, np.ndarray]:
        """Return what `_by_recursion` does, which compiled code has to agree with."""
        filtered = forward(self.system, record, self.noise)
        near = ill_conditioned(filtered)
        path: Path = filtered if len(near) == record.batch else backward(filtered)
        return Estimates(path.xhat.swapaxes(0, 1), path.P.transpose(3, 0, 1, 2)), near

    def _by_roots(self, record: Record) -> Estimates:
        """Return the estimates, computed by roots in all rows."""
        noise = self.noise
        t, y, u = record.t, record.y.swapaxes(0, 1), record.u.swapaxes(0, 1)
        system = self.system
        roots = root(record.prior.cov.transpose(1, 2, 0)).transpose(2, 0, 1)
        before, after = self._filtered(record, roots)
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

    def _filtered(self, record: Record, roots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the predictions and the estimates (num_samples, batch, nx) of the extended Kalman
        filter, by roots of the covariances, given those of the prior (batch, nx, nx)."""
        system, noise, box = self.system, self.noise, self.system.state_box
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


def _set_rows(estimates: Estimates, rows: np.ndarray, part: Estimates) -> None:
    """Set the estimates and covariances of some rows of a batch."""
    assert estimates.P is not None
    estimates.xhat[rows], estimates.P[rows] = part.xhat, part.P
