"""The sliding-mode observer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.estimation.constant_gain import ConstantGainObserver
from pinnobs_gym.estimation.estimator import Range
from pinnobs_gym.estimation.observer_gains import default_rate, settling_gain
from pinnobs_gym.estimation.takes import EVERYTHING


@dataclass(frozen=True)
class SlidingMode(ConstantGainObserver):
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

    When to choose it: where an unknown force or an error of the model is bounded and acts where the
    outputs see it. With a right model it is no better than `luenberger` by much, and far from a
    filter.
    """

    rate: float | None = None
    """Decay rate of errors in 1/s; 20 time constants per benchmark episode if None."""
    switching: float = 5.0
    """Ratio ρ/ε of the switching term to the width of the boundary layer."""
    layer: float = 5.0
    """Width ε of the boundary layer in standard deviations of the output noise."""

    name = "sliding_mode"
    template = "observer"
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

    def designed(self) -> np.ndarray:
        """Return the gain L, shape (nx, ny), in state units per output unit and s.

        Raises:
            ValueError: in one line, if the design has no solution.
        """
        rate = default_rate(self.system) if self.rate is None else self.rate
        return settling_gain(self.system, rate, 1 + self.switching)

    def secant(self, innovation: np.ndarray, t: float) -> np.ndarray:
        layer = self.layer * np.sqrt(np.einsum("iib->bi", self.noise.R(t)))
        return 1 + self.switching / np.maximum(abs(innovation) / layer, 1.0)

    def plan_settings(self) -> dict[str, Any]:
        return super().plan_settings() | {"switching": self.switching, "layer": self.layer}
