"""The cubature Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.sigma_points import SigmaPointFilter


@dataclass(frozen=True)
class CKF(SigmaPointFilter):
    """The cubature Kalman filter of third degree (Arasaratnam & Haykin 2009). Its 2·nx points
    x̂ ± √nx·columns of √P have equal weights.

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.

    When to choose it: in place of `ukf`, where nothing about its points is to be set. The two
    hardly differ.
    """

    name = "ckf"
    equations = (
        r"""
\xi_i &= \pm \sqrt{n_x}\, \mathbf e_i, \qquad w_i = v_i = \frac{1}{2 n_x} \\"""
        + SigmaPointFilter.equations
    )

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nx = self.system.nx
        axes = np.sqrt(nx) * np.eye(nx)
        weights = np.full(2 * nx, 0.5 / nx)
        return np.concatenate([axes, -axes]), weights, weights
