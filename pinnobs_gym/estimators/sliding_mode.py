"""The sliding-mode observer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import Range, State
from pinnobs_gym.estimation.observer_gains import (
    default_rate,
    injection,
    settling_gain,
    time_since,
)
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class SlidingMode(RecursiveEstimator):
    """The sliding-mode observer with a boundary layer (Slotine, Hedrick & Misawa 1987):
    x̂' = f(t, x̂, u) + L(e + ρ·sat(e/ε)), e = y − h(t, x̂, u).

    The switching term drives e to the surface e = 0 as long as it exceeds the unmodelled part of
    the output's rate. Within the boundary layer it acts as a higher gain; beyond the layer it is
    constant. At a sample the observer applies the correction over the time since the output's
    previous sample, by Euler's implicit method with the secant of the saturation, which avoids
    chattering.

    Default tuning is the same rule for all systems: L is designed as for the Luenberger observer
    (`pinnobs_gym.estimation.observer_gains.settling_gain`), ε is `layer` standard deviations of the
    output noise, and ρ = `switching`·ε.
    """

    rate: float | None = None
    """Decay rate of errors in 1/s; 20 time constants per benchmark episode if None."""
    switching: float = 5.0
    """Ratio ρ/ε of the switching term to the width of the boundary layer."""
    layer: float = 5.0
    """Width ε of the boundary layer in standard deviations of the output noise."""

    name = "sliding_mode"
    knows = ("model", "prior", "noise", "initial set")
    exempt_from = {
        "noise_matrix": "its layer is as wide as each output's own noise",
        "sampled_noise": "the noise changes the width of its layer, not its gain within",
    }
    takes = EVERYTHING - {"maps"}  # its gain is that of a rate of change
    equations = r"""
e &= y_k - h(t_k, \hat x_k^-, u_k), \qquad
s_j = 1 + \frac{\rho_j}{\varepsilon_j} \min\Bigl( 1, \frac{\varepsilon_j}{|e_j|} \Bigr) \\
K &= \Delta t\, L \operatorname{diag}(s)\, (I + \Delta t\, H L \operatorname{diag}(s))^{-1} \\
\hat x_k &= \hat x_k^- + K e
"""
    tunable = {
        "rate": Range(0.1, 1e3, log=True),
        "switching": Range(0.1, 100.0, log=True),
        "layer": Range(0.5, 50.0, log=True),
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rate", "switching", "layer"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise ValueError(f"{name}={value}; expected a positive number")

    def reset(self, prior: Prior) -> State:
        rate = default_rate(self.system) if self.rate is None else self.rate
        L = settling_gain(self.system, rate, 1 + self.switching)
        return State(prior.mean.astype(float), memory=(L, None))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        xhat = model_step(self.system, state.t, t, state.xhat, state.u, u)
        return State(xhat, state.t, state.u, memory=state.memory)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        xhat, (L, last) = state.xhat, state.memory
        layer = self.layer * np.sqrt(np.einsum("iib->bi", self.noise.R(t)))
        missing = np.isnan(y)
        dt, last = time_since(last, t, missing)
        innovation = self.system.output_residual(y, self.system.h(t, xhat, u))
        innovation = np.where(missing, 0.0, innovation)
        secant = 1 + self.switching / np.maximum(abs(innovation) / layer, 1.0)
        H = np.asarray(self.system.h_jacobian(t, xhat, u))
        K = injection(L, H, dt * secant)
        xhat = xhat + (K @ innovation[..., None])[..., 0]
        return State(xhat, t, u, innovation=innovation, memory=(L, last))
