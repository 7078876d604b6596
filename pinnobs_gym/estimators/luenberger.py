"""The Luenberger observer with a constant gain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.estimation.constant_gain import ConstantGainObserver
from pinnobs_gym.estimation.estimator import Range
from pinnobs_gym.estimation.observer_gains import (
    default_rate,
    lmi_gain,
    placed_gain,
    settling_gain,
)
from pinnobs_gym.estimation.takes import EVERYTHING
from pinnobs_gym.simulation.record import Prior

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode


@dataclass(frozen=True)
class Luenberger(ConstantGainObserver):
    """The Luenberger observer x̂' = f(t, x̂, u) + L(y − h(t, x̂, u)) with a constant gain
    (Luenberger 1964).

    Between samples the observer integrates the model. At a sample it applies the correction over
    the time since the output's previous sample, by Euler's implicit method
    (`pinnobs_gym.estimation.constant_gain`). A missing output contributes no correction.
    Gains are designed for scaled outputs, so that estimates do not depend on the outputs' units.

    Default tuning is the same rule for all systems. For each of 16 states of the benchmark's
    initial set, the model is linearised a quarter of a benchmark episode later, and a gain places
    the observer's poles to the left of −`rate`
    (`pinnobs_gym.estimation.observer_gains.placed_gains`). L is the one of these gains, or the
    fraction of it, that leaves the smallest error along the model's trajectories from the 16
    states in the worst case (`pinnobs_gym.estimation.observer_gains.settling_gain`).

    When to choose it: where a step may cost a few operations only, or the noise is not known; and
    as the baseline of all observers with a constant gain. Any filter that knows the noise is far
    more precise on the systems here.
    """

    gain: Sequence[Sequence[float]] | None = None
    """The gain L, nx rows of ny numbers, in state units per output unit and s; designed if None."""
    design: str = "poles"
    """Design of the gain: ``poles``, or ``lmi`` for one gain valid on the whole initial set
    (`pinnobs_gym.estimation.observer_gains.lmi_gain`; needs the extra lmi)."""
    poles: Sequence[complex] | None = None
    """The nx poles to place, in 1/s; derived from the rate if None."""
    rate: float | None = None
    """Decay rate of errors in 1/s; 20 time constants per benchmark episode if None."""

    name = "luenberger"
    template = "observer"
    takes = EVERYTHING - {"maps"}  # its gain is that of a rate of change
    equations = r"""
\hat x_k &= \hat x_k^- + K\, (y_k - h(t_k, \hat x_k^-, u_k)) \\
K &= \Delta t\, L\, (I + \Delta t\, H L)^{-1}, \qquad
H = \tfrac{\partial h}{\partial x}(t_k, \hat x_k^-, u_k) \\
\text{poles: } L &= P H^\top, \qquad (A + \rho I) P + P (A + \rho I)^\top - P H^\top H P
+ (0.1 \rho)^2 I = 0 \\
\text{lmi: } L &= P^{-1} Y, \qquad P A + A^\top P - Y H - H^\top Y^\top + 2 \rho P \preceq 0
\text{ for all } A, H
"""
    tunable = {"rate": Range(0.1, 1e3, log=True)}
    knows = ("model", "prior", "initial set")

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.design not in ("poles", "lmi"):
            raise ValueError(f"design={self.design!r}; expected 'poles' or 'lmi'")
        if self.rate is not None and not 0 < self.rate < np.inf:
            raise ValueError(f"rate={self.rate}; expected a positive number")
        shape = (self.system.nx, self.system.ny)
        if self.gain is not None and np.shape(self.gain) != shape:
            raise ValueError(f"gain has shape {np.shape(self.gain)}; expected (nx, ny)={shape}")

    def designed(self) -> np.ndarray:
        """Return the gain L, shape (nx, ny), in state units per output unit and s.

        Raises:
            ValueError: in one line, if the design has no solution.
        """
        if self.gain is not None:
            return np.asarray(self.gain, dtype=float)
        rate = default_rate(self.system) if self.rate is None else self.rate
        if self.design == "lmi":
            return lmi_gain(self.system, rate)
        if self.poles is not None:
            return placed_gain(self.system, rate, self.poles)
        return settling_gain(self.system, rate)

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        from pinnobs_gym.estimation.export.algorithm import Algorithm, model_parts, own
        from pinnobs_gym.simulation.kernels.source import read

        ny = self.system.ny
        fields = (
            f"@real@ innovation[{ny}]; /* outputs less their predictions; 0 where missing */",
            f"double last[{ny}]; /* time of each output's last sample */",
        )
        lanes, texts = (
            [*model_parts(code), read("solve.c")],
            [own("between.c"), own("luenberger.c")],
        )
        return Algorithm(lanes, texts, {"gain": self.designed()}, fields)
