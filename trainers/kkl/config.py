"""The settings that the trainers of KKL observers share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeAlias, get_args

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
from pinnobs_gym.training.loop import expect
from trainers.kkl.fitting import Method
from trainers.kkl.labels import frequency

Device: TypeAlias = Literal["auto", "cpu", "cuda"]
Preset: TypeAlias = Literal["default", "faithful"]

_PRESET: Any = None  # stands for what the preset says, which `KKLConfig` puts in its place
_CYCLES = 4.0
"""Fewest periods of the cut-off in the benchmark's episodes, unless it is given."""
_PART = 0.4
"""The cut-off over the frequency of the outputs, unless it is given."""


DEFAULT: Mapping[str, Any] = MappingProxyType(
    {
        "design": "bessel",
        "order": None,
        "mode": "continuous",
        "start": "output",
        "transient": True,
        "trajectories": 1000,
        "samples": 200,
        "depth": 2,
        "width": 28,
        "activation": "tanh",
        "method": "gauss_newton",
        "learning_rate": 0.3,
        "batch": 800,
        "iterations": 600,
        "share": 0.2,
        "noise": True,
        "dtype": "float64",
    }
)
"""The settings of the default presets."""


@dataclass(frozen=True)
class KKLConfig:
    """What the recipes of the learned KKL observers share.

    Settings that are not given are those of the preset; see the trainer's ``PRESETS``.
    """

    episodes: ClassVar[int] = 1
    """How many episodes of the env it looks at: their sample times alone."""
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = MappingProxyType({})
    """The settings of each preset."""

    preset: Preset = "default"
    """Where the other settings come from: the paper's recipe, or a better one."""
    design: Design = _PRESET
    """The poles of A_z: Bessel's at ``cutoff``; −1, −2, ... (niazi); ``poles``; or learned
    beforehand with a small T*, beginning with ``poles`` (see `learned_poles`)."""
    cutoff: float | None = None
    """Cut-off of Bessel's poles in Hz; if None, two fifths of the outputs' `labels.frequency`, but
    not under four over the benchmark's duration."""
    order: int | None = _PRESET
    """Bessel's poles for each output; if None, as many as give z one component more than x. Ramos
    et al. take nx + 1 for each."""
    poles: tuple[float, ...] = ()
    """Given poles in 1/s, all real, for each output."""
    mode: Mode = _PRESET
    """Continuous time, exact for outputs joined by straight lines; or discrete, by Euler steps."""
    start: Start = _PRESET
    """z before the first sample: at rest under y₀ (output), 0 (zero), or T(x̂₀) (prior)."""
    transient: bool = _PRESET
    """Whether T* is told the time since the first sample, as e^(−rt), so that it inverts z from the
    start on and not only when its beginning is forgotten."""
    low: tuple[float, ...] | None = None
    """Lower corner of a box of initial states to train on instead of the benchmark's set."""
    high: tuple[float, ...] | None = None
    """Upper corner."""
    trajectories: int = _PRESET
    """Episodes that are simulated, a tenth more to validate."""
    samples: int = _PRESET
    """Samples of each that are kept."""
    depth: int = _PRESET
    """Hidden layers of T and of T*."""
    width: int = _PRESET
    """Neurons in each."""
    activation: Activation = _PRESET
    """Of the hidden layers."""
    method: Method = _PRESET
    """Averaged Gauss-Newton steps, or Adam."""
    learning_rate: float = _PRESET
    """The first step; it falls as a half cosine."""
    batch: int = _PRESET
    """Equations in a step: samples times the outputs of the network."""
    iterations: int = _PRESET
    """Steps for T*."""
    share: float = _PRESET
    """Steps for T over those for T*; so for their CPU time if there is a budget."""
    patience: float = 0.6
    """Part of the steps without a lower validation error after which a network is done."""
    noise: bool = _PRESET
    """Whether z is trained on with the output noise that is told."""
    dtype: Literal["float32", "float64"] = _PRESET
    """Precision of the networks; labels are always in double."""
    device: Device = "auto"
    """Where networks are trained; ``auto`` takes a GPU if there is one."""
    sweep: Literal["none", "cutoff"] = "none"
    """Whether the cut-off is first chosen by short trainings over many."""
    seed: int = 0
    """What weights, initial states and noise are drawn from."""
    budget: float | None = None
    """CPU seconds by which the step's cosine has come to its end, and training with it."""
    check_every: int = 20
    """Steps from one validation to the next."""
    checkpoint_every: int = 100
    """Steps from one checkpoint to the next."""
    log_every: int = 20
    """Steps from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        expect(self, "preset", " or ".join(self.PRESETS), lambda v: v in self.PRESETS)
        for name, value in self.PRESETS[self.preset].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        choices = {"design": Design, "mode": Mode, "start": Start, "activation": Activation}
        choices |= {"method": Method, "device": Device}
        for name, kind in choices.items():
            expect(self, name, ", ".join(get_args(kind)), lambda v, k=kind: v in get_args(k))
        expect(self, "sweep", "none or cutoff", lambda v: v in ("none", "cutoff"))
        expect(self, "dtype", "float32 or float64", lambda v: v in ("float32", "float64"))
        whole = ("trajectories", "samples", "depth", "width", "batch", "iterations")
        for name in (*whole, "check_every", "checkpoint_every", "log_every"):
            expect(self, name, "a whole number of at least 1", lambda v: v == int(v) and v >= 1)
        expect(self, "seed", "a whole number of at least 0", lambda v: v == int(v) and v >= 0)
        expect(
            self, "order", "None or a whole number over 0", lambda v: v is None or v == int(v) > 0
        )
        expect(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        expect(self, "cutoff", "None or positive Hz", lambda v: v is None or 0 < v < math.inf)
        expect(self, "share", "a number over 0", lambda v: 0 < v < math.inf)
        expect(self, "patience", "a number over 0 and at most 1", lambda v: 0 < v <= 1)
        expect(self, "budget", "None or positive seconds", lambda v: v is None or v > 0)
        if self.design in ("poles", "learned"):
            expect(self, "poles", f"numbers, for design={self.design!r}", lambda v: len(v) > 0)
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
