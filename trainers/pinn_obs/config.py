"""The settings of the trainer of PINN-Obs, in two presets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, TypeAlias, get_args

from pinnobs_gym.estimation.learned.mlp import Activation, Architecture, Precision
from pinnobs_gym.training.loop import expect

Preset: TypeAlias = Literal["fast", "paper"]
Device: TypeAlias = Literal["auto", "cpu", "cuda"]

PRESETS = MappingProxyType(
    {
        "fast": {
            "depth": 3,
            "optimiser": "ssbroyden",
            "iterations": 3000,
            "patience": 300,
            "improvement": 0.02,
            "train_fraction": 1.0,
            "points": 300,
            "guide": 10.0,
            "gain_penalty": 0.1,  # _TRANSFER with `Config.transfer`
            "dtype": "float64",
            "checkpoint_every": 200,
            "log_every": 20,
        },
        "paper": {
            "depth": 9,
            "optimiser": "adam",
            "iterations": 200_000,
            "patience": 20_000,
            "improvement": 0.0,
            "train_fraction": 0.6,
            "points": 0,
            "guide": 0.0,
            "gain_penalty": 0.0,
            "dtype": "float32",
            "checkpoint_every": 1000,
            "log_every": 100,
        },
    }
)
"""The settings in which the presets differ. Those of ``paper`` are from the paper's "Ablation
studies"."""

_TRANSFER = 0.3
"""``gain_penalty`` of a gain that is meant for other records: there the gain is the aim."""
_PRESET: Any = None  # stands for what the preset says, which `Config` puts in its place


@dataclass(frozen=True)
class Config:
    """The recipe of PINN-Obs.

    Settings that are not given are those of the preset: ``Config("paper", width=30)``. To change
    the preset of a config that is there, make a new one: its other settings are no longer open.
    """

    episodes: ClassVar[int] = 1
    """How many episodes it is trained on."""

    preset: Preset = "fast"
    """Where the other settings come from: the paper's recipe, or a fast one."""
    depth: int = _PRESET
    """Number of hidden layers."""
    width: int = 20
    """Neurons in each hidden layer."""
    activation: Activation = "tanh"
    """Activation of the hidden layers."""
    w0: float = 1.0
    """Weight of the initial estimate in the loss."""
    w_ode: float = 1.0
    """Weight of the observer's equation in the loss."""
    w_y: float = 1.0
    """Weight of the outputs in the loss."""
    guide: float = _PRESET
    """Weight in the loss of x̂'s squared departure from the guide, a Kalman smoother's estimates of
    the same record, in scaled units; the gain is then drawn towards Riccati's. With 0 there is no
    guide. Not of Adam's."""
    transfer: bool = False
    """Whether the gain is meant for other records, too: x̂ then leaves x̂₀ as fast as Riccati's gain
    takes it, and not by a gain that fits this record alone. Needs the guide."""
    gain_penalty: float = _PRESET
    """Weight in the loss of the gain's squared departure from the guide's, or from zero without
    one, over its size and ten units of state, output and time; 1e-3 is a good one without a guide.
    Not of Adam's."""
    learning_rate: float = 1e-3
    """Step of Adam; constant."""
    optimiser: Literal["adam", "ssbroyden"] = _PRESET
    """Method that minimises the loss: Adam, on samples; or self-scaled Broyden, in scaled
    quantities."""
    iterations: int = _PRESET
    """Most iterations."""
    patience: int = _PRESET
    """Iterations without a lower training loss after which training stops."""
    improvement: float = _PRESET
    """How much lower the loss has to be for the patience to begin anew, relative to it."""
    train_fraction: float = _PRESET
    """Part of the samples that Adam trains on; the others only measure the held-out loss."""
    points: int = _PRESET
    """Most samples that self-scaled Broyden looks at, five times as many if they are noisy."""
    dtype: Precision = _PRESET
    """Precision."""
    device: Device = "auto"
    """Where self-scaled Broyden trains on many records: at once on a GPU, or one after another on
    the CPU; ``auto`` takes a GPU if there is one. A single record is always trained on the CPU."""
    seed: int = 0
    """What the initial weights and the training samples are drawn from."""
    budget: float | None = None
    """CPU seconds after which training stops, those before a resumption included."""
    checkpoint_every: int = _PRESET
    """Iterations from one checkpoint to the next."""
    log_every: int = _PRESET
    """Iterations from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        expect(self, "preset", " or ".join(get_args(Preset)), lambda v: v in PRESETS)
        preset: dict[str, Any] = PRESETS[self.preset]
        if self.transfer:
            preset = preset | {"gain_penalty": _TRANSFER}
        for name, value in preset.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        Architecture(1, 1, self.depth, self.width, self.activation, self.dtype)
        for name in ("iterations", "patience", "checkpoint_every", "log_every"):
            expect(self, name, "a whole number of at least 1", lambda v: v == int(v) and v >= 1)
        expect(self, "seed", "a whole number of at least 0", lambda v: v == int(v) and v >= 0)
        for name in ("w0", "w_ode", "w_y", "guide", "gain_penalty"):
            expect(self, name, "a number of at least 0", lambda v: 0 <= v < math.inf)
        expect(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        expect(self, "improvement", "a number of at least 0 and under 1", lambda v: 0 <= v < 1)
        expect(self, "train_fraction", "a number over 0 and at most 1", lambda v: 0 < v <= 1)
        expect(self, "optimiser", "adam or ssbroyden", lambda v: v in ("adam", "ssbroyden"))
        expect(self, "device", "auto, cpu or cuda", lambda v: v in get_args(Device))
        expect(self, "budget", "None or positive seconds", lambda v: v is None or v > 0)
        if self.optimiser == "ssbroyden":
            expect(self, "points", "a whole number of at least 10", lambda v: v == int(v) >= 10)
            expect(self, "dtype", "float64 with ssbroyden", lambda v: v == "float64")
            expect(self, "train_fraction", "1.0 with ssbroyden", lambda v: v == 1)
        if not self.guide:
            expect(self, "transfer", "False without a guide", lambda v: v is False)
        if self.optimiser == "adam":
            for name in ("guide", "gain_penalty"):
                expect(self, name, "0 with adam", lambda v: v == 0)
