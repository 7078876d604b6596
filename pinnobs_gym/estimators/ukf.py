"""The unscented Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.sigma_points import SigmaPointFilter


@dataclass(frozen=True)
class UKF(SigmaPointFilter):
    """The unscented Kalman filter (Julier & Uhlmann 1997) with 2·nx + 1 points.

    The centre has the weight κ/(nx + κ), κ = max(0, 3 − nx), and the points x̂ ± √(nx + κ)·columns
    of √P have the weights 1/(2(nx + κ)). This is van der Merwe's α = 1, for which no weight is
    negative. In covariances the weight of the centre is larger by β (van der Merwe 2004).

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.

    When to choose it: by default: where f or h bend, it is more precise than `ekf` and more
    reliable from a poor first guess, needs no Jacobians, and costs two to three times as much.
    """

    beta: float = 0.0
    """Number β added to the weight of the centre in covariances."""

    name = "ukf"
    equations = (
        r"""
\xi_0 &= 0, \quad \xi_i = \pm \sqrt{n_x + \kappa}\, \mathbf e_i, \qquad \kappa = \max(0, 3 - n_x) \\
w_0 &= \frac{\kappa}{n_x + \kappa}, \quad v_0 = w_0 + \beta, \qquad
w_i = v_i = \frac{1}{2 (n_x + \kappa)} \\"""
        + SigmaPointFilter.equations
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.beta < np.inf:
            raise ValueError(f"beta={self.beta}; expected a number of at least 0")

    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        nx = self.system.nx
        spread = float(max(nx, 3))  # nx + κ
        axes = np.sqrt(spread) * np.eye(nx)
        weights = np.append(1 - nx / spread, np.full(2 * nx, 0.5 / spread))
        points = np.concatenate([np.zeros((1, nx)), axes, -axes])
        return points, weights, weights + np.append(self.beta, np.zeros(2 * nx))
