"""A window of samples whose states all follow from the first one, with the prior of that state.

Matrices have the batch as their last axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.kalman import joseph_update, observe, predict
from pinnobs_gym.estimation.least_squares import Fit, linearised
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.estimation.window_samples import WindowSamples
from pinnobs_gym.simulation.matrices import cholesky, divide, identity, mapped, product, sandwich
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System


@dataclass(frozen=True)
class ExactWindow:
    """The window and the prior of its first state, of a model without process noise in it."""

    arrival: np.ndarray
    """x̄, the estimate of the window's first state from all samples before the window, shape
    (batch, nx)."""
    P: np.ndarray
    """P̄, the covariance of x̄, shape (nx, nx, batch)."""
    start: np.ndarray
    """The current estimate of the window's first state, shape (batch, nx)."""
    samples: WindowSamples
    """The window's samples."""

    def extended(self, t: float, y: np.ndarray, u: np.ndarray) -> ExactWindow:
        """Return the window with one more sample: y (batch, ny) and u (batch, nu) at time t (s)."""
        return replace(self, samples=self.samples.extended(t, y, u))

    def rows(self, rows: np.ndarray) -> ExactWindow:
        """Return the windows of some rows of the batch."""
        own = self.arrival[rows], self.P[..., rows], self.start[rows]
        return ExactWindow(*own, self.samples.rows(rows))

    def shortened(self, system: System, noise: Noise) -> ExactWindow:
        """Return the window without its first sample, with which x̄ and P̄ are updated as in an
        extended Kalman filter linearised about the estimate of the first state from all samples.
        There is a second sample."""
        start, (t0, y0, u0), (t1, _, u1) = self.start, self.samples.at(0), self.samples.at(1)
        innovation, H = observe(system, t0, start, y0, u0)
        # Update x̄ − x and P̄ with the sample, with the output linearised about x.
        offset = system.state_residual(self.arrival, start)
        innovation = innovation - mapped(H, offset)
        offset, P, _ = joseph_update(offset, self.P, innovation, H, noise.R(t0, y0))
        # Predict x, x̄ and P̄ to the next sample, which becomes the first of the window.
        start, P, F, _ = predict(system, (t0, t1), start, P, noise, (u0, u1))
        return ExactWindow(start + mapped(F, offset), P, start, self.samples.without_first())

    def fit(self, system: System, noise: Noise) -> Fit:
        """Return the model's trajectory through the window from its first state, and the normal
        equations of the outputs about it."""
        X = identity(*self.start.shape[::-1])
        samples = [self.samples.at(k) for k in range(len(self.samples))]
        t, y, u = zip(*samples, strict=True)
        return linearised(system, noise, t, y, u, self.start, X)

    def step(self, system: System, fit: Fit) -> tuple[np.ndarray, np.ndarray]:
        """Return the Gauss-Newton step (batch, nx) of the first state x, within its bounds, and the
        covariance (P̄⁻¹ + Λ)⁻¹ (nx, nx, batch) of the result, where Λ is the fit's information.

        P̄ may be singular, so its inverse is avoided; components with zero variance in P̄ then follow
        x̄.
        """
        offset = system.state_residual(self.arrival, self.start)
        # With P̄ = LLᵀ, (P̄⁻¹ + Λ)⁻¹ = L(I + LᵀΛL)⁻¹Lᵀ.
        L = cholesky(self.P, semidefinite=True)
        L_transposed = L.transpose(1, 0, 2)
        inner = identity(len(L), L.shape[-1]) + product(product(L_transposed, fit.information), L)
        P = product(divide(L, inner), L_transposed)
        # The step is that to x̄ plus the correction by the outputs from there.
        right = fit.right.T - mapped(fit.information, offset)
        step, box = offset + mapped(P, right), system.state_box
        if box is not None:
            step = nearest(self.start + step, P.transpose(2, 0, 1), box) - self.start
        return step, P


def innovation_covariance(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return S = HP⁻Hᵀ + R, shape (ny, ny, batch), computed as R(R − HPHᵀ)⁻¹R from the covariance P
    after the update."""
    R = np.broadcast_to(R, (*R.shape[:2], P.shape[-1]))
    S = product(divide(R, R - sandwich(H, P)), R)
    return (S + S.transpose(1, 0, 2)) / 2
