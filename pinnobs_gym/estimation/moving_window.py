"""A window of samples whose states are all unknown, with the prior of the first one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.linear_window import (
    Smoothed,
    joint_covariance,
    linear_window,
    smoothed,
    whitened,
)
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.estimation.square_root import compressed, root_of, updated
from pinnobs_gym.estimation.window_samples import WindowSamples
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class MovingWindow:
    """The window and the prior of its first state. The batch is the first axis of matrices."""

    mean: np.ndarray
    """x̄, the estimate of the window's first state from all samples before, shape (batch, nx)."""
    root: np.ndarray
    """Root of its covariance P̄, shape (batch, nx, nx)."""
    x: np.ndarray
    """Estimates of the states at the window's samples, shape (num_samples, batch, nx)."""
    exact: bool
    """Whether the model is assumed to have no process noise in the window."""
    samples: WindowSamples
    """The window's samples."""

    def extended(self, system: System, t: float, y: np.ndarray, u: np.ndarray) -> MovingWindow:
        """Return the window with one more sample, whose state is predicted by the model: y
        (batch, ny) and u (batch, nu) at time t (s)."""
        x = self.x
        if len(self.samples):
            before, _, inputs = self.samples.at(-1)
            ahead = model_step(system, before, t, x[-1], inputs, u)
            x = np.concatenate([x, ahead[None]])
        return replace(self, x=x, samples=self.samples.extended(t, y, u))

    def rows(self, rows: np.ndarray) -> MovingWindow:
        """Return the windows of some rows of the batch."""
        own = self.mean[rows], self.root[rows], self.x[:, rows]
        # Contiguous, so that sums are formed in one order in any batch.
        mean, root, x = map(np.ascontiguousarray, own)
        return MovingWindow(mean, root, x, self.exact, self.samples.rows(rows))

    def shortened(self, system: System, noise: Noise) -> MovingWindow:
        """Return the window without its first sample, with which x̄ and P̄ are updated as in an
        extended Kalman filter linearised about the estimate of the first state from all samples, in
        roots (Kühl, Diehl, Kraus, Schlöder & Bock 2011, "A real-time algorithm for moving horizon
        state and parameter estimation"). There is a second sample."""
        x, batch = self.x[0], len(self.mean)
        (t0, y0, u0), (t1, _, u1) = self.samples.at(0), self.samples.at(1)
        e, H = whitened(system, noise, (t0, y0, u0), x)
        # Update x̄ − x with the sample.
        deviation = system.state_residual(self.mean, x)
        unit = np.broadcast_to(np.eye(H.shape[1]), (batch, H.shape[1], H.shape[1]))
        step, L = updated(self.root, e - (H @ deviation[..., None])[..., 0], H, unit)
        # Predict it to the next sample.
        end, F, Q = model_step_moments(system, noise, t0, t1, x, u0, u1)
        F = np.ascontiguousarray(F.transpose(2, 0, 1))
        G = np.broadcast_to(root_of(Q.transpose(2, 0, 1)), F.shape)
        mean = end + (F @ (deviation + step)[..., None])[..., 0]
        L = np.ascontiguousarray(compressed(F @ L, G))  # sums in one order, as in `rows`
        return MovingWindow(mean, L, self.x[1:], self.exact, self.samples.without_first())

    def improved(self, system: System, noise: Noise) -> tuple[MovingWindow, Smoothed]:
        """Return the window after a Gauss-Newton step of all its states, within their bounds, and
        the states without bounds with their covariances."""
        t, y, u = zip(*(self.samples.at(k) for k in range(len(self.samples))), strict=True)
        window = linear_window(system, noise, t, y, u, self.x, self.exact)
        states = smoothed(window, system.state_residual(self.mean, window.r[0]), self.root)
        box, x = system.state_box, states.x
        if box is not None and box.outside(x).any():
            x = _inside(states, box)
        return replace(self, x=x), states


def _inside(states: Smoothed, box: StateBox) -> np.ndarray:
    """Return the states (num_samples, batch, nx) within the bounds that are nearest to those of the
    window, all together."""
    n, _, nx = states.x.shape
    rows = np.flatnonzero(box.outside(states.x).any(axis=0))
    whole = StateBox(np.tile(box.low, n), np.tile(box.high, n))
    together = states.x[:, rows].swapaxes(0, 1).reshape(len(rows), n * nx)
    moved = nearest(together, joint_covariance(states, rows), whole)
    x = states.x.copy()
    x[:, rows] = moved.reshape(len(rows), n, nx).swapaxes(0, 1)
    return x
