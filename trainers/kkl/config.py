"""The settings that the trainers of KKL observers share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias, TypeVar, get_args

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
from pinnobs_gym.training.settings import TrainingConfig, check_choice, check_setting, check_whole
from trainers.kkl.fitting import Method
from trainers.kkl.labels import frequency

Device: TypeAlias = Literal["auto", "cpu", "cuda"]
Precision: TypeAlias = Literal["float32", "float64"]
Sweep: TypeAlias = Literal["none", "cutoff"]

_CYCLES = 4.0
"""Fewest periods of the cut-off in the benchmark's episodes, unless it is given."""
_PART = 0.4
"""The cut-off over the frequency of the outputs, unless it is given."""


@dataclass(frozen=True)
class KKLConfig(TrainingConfig):
    """What the recipes of the learned KKL observers share."""

    may_change = ("device",)

    design: Design = "bessel"
    """The poles of A_z: Bessel's at ``cutoff``; −1, −2, ... (niazi); ``poles``; or learned
    beforehand with a small T*, beginning with ``poles`` (see `learned_poles`)."""
    cutoff: float | None = None
    """Cut-off of Bessel's poles in Hz; if None, two fifths of the outputs' `labels.frequency`, but
    not under four over the benchmark's duration."""
    order: int | None = None
    """Bessel's poles for each output; if None, as many as give z one component more than x. Ramos
    et al. take nx + 1 for each."""
    poles: tuple[float, ...] = ()
    """Given poles in 1/s, all real, for each output."""
    mode: Mode = "continuous"
    """Continuous time, exact for outputs joined by straight lines; or discrete, by Euler steps."""
    start: Start = "output"
    """z before the first sample: at rest under y₀ (output), 0 (zero), or T(x̂₀) (prior)."""
    transient: bool = True
    """Whether T* is told the time since the first sample, as e^(−rt), so that it inverts z from the
    start on and not only when its beginning is forgotten."""
    low: tuple[float, ...] | None = None
    """Lower corner of a box of initial states to train on instead of the benchmark's set."""
    high: tuple[float, ...] | None = None
    """Upper corner."""
    trajectories: int = 1000
    """Episodes that are simulated, a tenth more to validate."""
    samples: int = 200
    """Samples of each that are kept."""
    depth: int = 2
    """Hidden layers of T and of T*."""
    width: int = 28
    """Neurons in each."""
    activation: Activation = "tanh"
    """Of the hidden layers."""
    method: Method = "gauss_newton"
    """Averaged Gauss-Newton steps, or Adam."""
    learning_rate: float = 0.3
    """The first step; it falls as a half cosine."""
    batch: int = 800
    """Equations in a step: samples times the outputs of the network."""
    iterations: int = 600
    """Steps for T*."""
    share: float = 0.2
    """Steps for T over those for T*; so for their CPU time if there is a budget."""
    patience: float = 0.6
    """Part of the steps without a lower validation error after which a network is done."""
    noise: bool = True
    """Whether z is trained on with the output noise that is told."""
    dtype: Precision = "float64"
    """Precision of the networks; labels are always in double."""
    device: Device = "auto"
    """Where networks are trained; ``auto`` takes a GPU if there is one."""
    sweep: Sweep = "none"
    """Whether the cut-off is first chosen by short trainings over many."""
    budget: float | None = None
    """CPU seconds by which the step's cosine has come to its end, and training with it."""
    check_every: int = 20
    """Steps from one validation to the next."""
    checkpoint_every: int = 100
    """Steps from one checkpoint to the next."""
    log_every: int = 20
    """Steps from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        self.check_shared()
        choices = {"design": Design, "mode": Mode, "start": Start, "activation": Activation}
        choices |= {"method": Method, "device": Device, "sweep": Sweep, "dtype": Precision}
        for name, kind in choices.items():
            check_choice(self, name, get_args(kind))
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
        """Bessel's poles for each output."""
        return self.order or math.ceil((system.nx + 1) / system.ny)

    def cutoff_for(self, system: System) -> float:
        """The cut-off for a system, in Hz."""
        if self.cutoff is not None:
            return self.cutoff
        return max(_CYCLES / system.setups["benchmark"].duration, _PART * frequency(system))

    def dynamics(self, system: System) -> Dynamics:
        """A_z and B_z for a system.

        Raises:
            ValueError: in one line, if they do not give an observer.
        """
        if self.design == "bessel":
            poles: Sequence[complex] = bessel(self.filters(system), self.cutoff_for(system))
        elif self.design == "niazi":
            poles = niazi(system.nx)
        else:
            poles = self.poles
        enough(len(poles), system.nx, system.ny)
        return realised(poles, system.ny, self.mode)


KKLConfigT = TypeVar("KKLConfigT", bound=KKLConfig)


def as_published(config: KKLConfigT, **changes: Any) -> KKLConfigT:
    """A recipe with the settings that those of the three methods' papers have in common: z from 0,
    no noise, Adam; and with further changes."""
    common: dict[str, Any] = {
        "start": "zero",
        "transient": False,
        "width": 50,
        "method": "adam",
        "learning_rate": 1e-3,
        "batch": 256,
        "iterations": 12_000,
        "noise": False,
        "dtype": "float32",
    }
    return replace(config, **{**common, **changes})
