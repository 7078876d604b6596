"""The settings of all trainers of KKL observers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, TypeVar

from pinnobs_gym.estimation.learned.kkl_dynamics import (
    Design,
    Dynamics,
    Mode,
    Start,
    bessel,
    enough,
    niazi,
    realised,
)
from pinnobs_gym.estimation.learned.kkl_maps import Activation
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.settings import TrainingConfig, check_setting, check_whole
from trainers.kkl.fitting import FitMethod
from trainers.kkl.labels import drives, frequency

Device: TypeAlias = Literal["auto", "cpu", "cuda"]
"""Device of the training; ``auto`` takes a GPU if there is one."""
Precision: TypeAlias = Literal["float32", "float64"]
"""Precision of the networks."""
Sweep: TypeAlias = Literal["none", "cutoff"]
"""Whether several time constants of z are tried."""

_CYCLES = 4.0
"""Fewest periods of the default cut-off in a benchmark episode."""
_PART = 0.4
"""Default cut-off over the frequency of the outputs."""


@dataclass(frozen=True)
class KKLConfig(TrainingConfig):
    """Base class of the settings of the learned KKL observers."""

    may_change = ("device",)

    design: Design = "bessel"
    """Poles of A_z: Bessel's at ``cutoff``; −1, −2, ... (niazi); ``poles``; or poles learned
    together with a small T*, from the initial values ``poles`` (learned; see `learned_poles`)."""
    cutoff: float | None = None
    """Cut-off of Bessel's poles in Hz; if None, two fifths of the outputs' `labels.frequency`, but
    at least four over the benchmark's duration."""
    order: int | None = None
    """Number of Bessel's poles per output; if None, the least that gives z at least nx + 1
    components. Ramos et al. use nx + 1 per output."""
    poles: tuple[float, ...] = ()
    """Poles in 1/s per output, all real."""
    mode: Mode = "continuous"
    """Continuous time, exact for piecewise linear outputs; or discrete time, by Euler steps."""
    start: Start = "output"
    """Initial z: the steady state for constant y₀ (output), 0 (zero), or T(x̂₀) (prior)."""
    transient: bool = True
    """Whether T* has the time since the first sample, as e^(−rt), as an input, so that it is valid
    also during the transient of z."""
    low: tuple[float, ...] | None = None
    """Lower corner of a box of initial states to train on instead of the benchmark's set."""
    high: tuple[float, ...] | None = None
    """Upper corner of that box."""
    trajectories: int = 1000
    """Number of simulated training episodes; a tenth as many more are simulated for validation."""
    samples: int = 200
    """Number of samples kept of each episode."""
    depth: int = 2
    """Number of hidden layers of T and of T*."""
    width: int = 28
    """Neurons in each hidden layer."""
    activation: Activation = "tanh"
    """Activation of the hidden layers."""
    method: FitMethod = "gauss_newton"
    """Averaged Gauss-Newton steps, or Adam."""
    learning_rate: float = 0.3
    """Initial step size; it decays as a half cosine."""
    batch: int = 800
    """Equations per step: samples times outputs of the network."""
    iterations: int = 600
    """Number of steps for T*."""
    share: float = 0.2
    """Steps for T over steps for T*, and CPU time likewise if there is a budget."""
    patience: float = 0.6
    """Fraction of a network's steps without a lower validation error after which it stops."""
    noise: bool = True
    """Whether the known output noise is added to z in training."""
    fallback: bool = True
    """Whether estimates are those of an unscented Kalman filter where z is outside of the region of
    the training; see `pinnobs_gym.estimators.kkl.KKL`."""
    dtype: Precision = "float64"
    """Precision of the networks; labels are always in double precision."""
    device: Device = "auto"
    """Device of the training; ``auto`` takes a GPU if there is one."""
    sweep: Sweep = "none"
    """Whether the cut-off is first chosen by short trainings at several cut-offs."""
    budget: float | None = None
    """CPU seconds of the training, by the end of which the step size has decayed."""
    check_every: int = 20
    """Steps between validations."""
    checkpoint_every: int = 100
    """Steps between checkpoints."""
    log_every: int = 20
    """Steps between points of the logged curves."""

    def __post_init__(self) -> None:
        self.check_shared()
        whole = ("trajectories", "samples", "depth", "width", "batch", "iterations", "check_every")
        check_whole(self, whole)
        check_setting(
            self, "order", "None or a whole number over 0", lambda v: v is None or v == int(v) > 0
        )
        check_setting(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        check_setting(
            self, "cutoff", "None or positive Hz", lambda v: v is None or 0 < v < math.inf
        )
        check_setting(self, "share", "a number over 0", lambda v: 0 < v < math.inf)
        check_setting(self, "patience", "a number over 0 and at most 1", lambda v: 0 < v <= 1)
        if self.design in ("poles", "learned"):
            expected = f"numbers, for design={self.design!r}"
            check_setting(self, "poles", expected, lambda v: len(v) > 0)
        if (self.low is None) != (self.high is None):
            raise ValueError(f"low={self.low}, high={self.high}; expected both corners or none")

    def filters(self, system: System) -> int:
        """Return the number of Bessel's poles per output."""
        return self.order or math.ceil((system.nx + 1) / system.ny)

    def cutoff_for(self, system: System) -> float:
        """Return the cut-off for a system in Hz."""
        if self.cutoff is not None:
            return self.cutoff
        return max(_CYCLES / system.setups["benchmark"].duration, _PART * frequency(system))

    def dynamics(self, system: System) -> Dynamics:
        """Return the dynamics of z for a system.

        Raises:
            ValueError: in one line, if they are not those of an observer.
        """
        if self.design == "bessel":
            poles: Sequence[complex] = bessel(self.filters(system), self.cutoff_for(system))
        elif self.design == "niazi":
            poles = niazi(system.nx)
        else:
            poles = self.poles
        enough(len(poles), system.nx, system.ny)
        return realised(poles, drives(system), self.mode)


KKLConfigT = TypeVar("KKLConfigT", bound=KKLConfig)


def as_published(config: KKLConfigT, **changes: Any) -> KKLConfigT:
    """Return a config with the settings common to the papers of the three methods, and further
    changes.

    The common settings are: z from 0, no noise, Adam, no fallback.
    """
    common: dict[str, Any] = {
        "start": "zero",
        "transient": False,
        "width": 50,
        "method": "adam",
        "learning_rate": 1e-3,
        "batch": 256,
        "iterations": 12_000,
        "noise": False,
        "fallback": False,
        "dtype": "float32",
    }
    return replace(config, **{**common, **changes})
