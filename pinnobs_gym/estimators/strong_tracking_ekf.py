"""The strong-tracking extended Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Range, State
from pinnobs_gym.estimation.gaussian import (
    GaussianEstimator,
    checked,
    corrected,
    covariances,
    enlarged,
    predicted,
)
from pinnobs_gym.estimation.kalman import cautious, observe
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.square_root import prior_root
from pinnobs_gym.estimation.wrapping import say_what_turns, wrapped_state
from pinnobs_gym.simulation.matrices import squared_size
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import vector


@dataclass(frozen=True)
class StrongTrackingEKF(RecursiveEstimator, GaussianEstimator):
    """The extended Kalman filter whose process noise grows with the innovation (Boutayeb & Aubry
    1999), so that its gain does not vanish on long records.

    Q_k = Q + `gamma`·eᵀR⁻¹e/ny·diag(scale²), with e the innovation at the previous sample and Q of
    the assumed process noise; optionally R_k = `output_factor`·HPHᵀ + R. The paper weights e with
    the identity instead of R⁻¹, which requires outputs of one unit. The update has Joseph's form.
    The innovation of a missing output is zero.

    Default tuning is the same rule for all systems: P₀ is that of the prior, the noise is the known
    one with `assumed_noise` added, and the settings are the defaults below.

    When to choose it: where parameters or loads jump without notice: it finds the state again at
    once. Where the model holds, `ekf` is more precise.
    """

    gamma: float = 1e-6
    """Variance of the process noise, relative to scale², that an innovation of one standard
    deviation of the output noise adds."""
    output_factor: float = 0.0
    """Factor with which HPHᵀ is added to R."""

    name = "strong_tracking_ekf"
    template = "ekf"
    exempt_from = {
        "sampled_noise": "an innovation ends the growth by the one before, however uncertain it is"
    }
    equations = r"""
Q_k &= Q + \frac{\gamma}{n_y} e_{k-1}^\top R^{-1} e_{k-1}
\operatorname{diag}(\mathrm{scale}^2) \\
P_k^- &= \Phi P_{k-1} \Phi^\top + Q_k \\
R_k &= R + r\, H P_k^- H^\top \quad (r: \text{output\_factor}) \\
K &= P_k^- H^\top (H P_k^- H^\top + R_k)^{-1} \\
\hat x_k &= \hat x_k^- + K e_k, \qquad e_k = y_k - h(t_k, \hat x_k^-, u_k) \\
P_k &= (I - K H)\, P_k^- (I - K H)^\top + K R_k K^\top
"""
    tunable = {
        **GaussianEstimator.tunable,
        "gamma": Range(1e-10, 1e-2, log=True),
        "output_factor": Range(0.0, 3.0),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("gamma", "output_factor"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name}={getattr(self, name)}; expected a number of at least 0")

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        L = prior_root(self.system, prior, self.noise.R(0.0))
        state = State(prior.mean, P=prior.cov, memory=np.zeros(len(prior.mean)), root=L)
        return wrapped_state(self.system, state)

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        state = predicted(self.system, state, covariances(state), self.noise, t, u)
        return wrapped_state(self.system, state)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        # Rows without any output leave the growth to the next sample that has one.
        seen, sizes, R = ~np.isnan(y).all(axis=1), state.memory, self.noise.R(t, y)
        growth = np.diag(self._growth())[..., None] * np.where(seen, sizes, 0.0)
        state = enlarged(state, growth)
        P = covariances(state)
        say_what_turns(self.label, self.system, (t, y, u), state.xhat, P, R)
        innovation, H = observe(self.system, t, state.xhat, y, u)
        sizes = np.where(seen, squared_size(innovation, R) / self.system.ny, sizes)
        R = cautious(P, H, R, self.output_factor)
        return corrected(replace(state, memory=sizes), (t, u), P, innovation, H, R)

    def _growth(self) -> np.ndarray:
        """Return the variances (nx,) that an innovation of size 1 adds."""
        return self.gamma * vector(self.system.scale, self.system.nx, "scale") ** 2

    def plan_settings(self) -> dict[str, Any]:
        return {"growth": self._growth(), "caution": self.output_factor, "carried": 1}

    def carried_memory(self, memory: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        sizes = np.array(memory, dtype=float)
        return sizes, {"carried": sizes}

    def memory_rows(self, memory: np.ndarray, rows: np.ndarray) -> np.ndarray:
        return memory[rows]

    def with_memory_rows(
        self, memory: np.ndarray, rows: np.ndarray, part: np.ndarray
    ) -> np.ndarray:
        sizes = memory.copy()
        sizes[rows] = part
        return sizes
