"""The settings of the trainer of PINN-Obs, and its presets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

from pinnobs_gym.estimation.learned.mlp import Activation, Architecture, Precision
from pinnobs_gym.training.settings import TrainingConfig, check_choice, check_setting, check_whole

Optimiser: TypeAlias = Literal["adam", "ssbroyden"]
Device: TypeAlias = Literal["auto", "cpu", "cuda"]


@dataclass(frozen=True)
class PinnObsConfig(TrainingConfig):
    """The recipe of PINN-Obs: the fast one, unless its settings are changed; see `paper`."""

    may_change = ("iterations", "device")

    depth: int = 3
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
    guide: float = 10.0
    """Weight in the loss of x̂'s squared departure from the guide, a Kalman smoother's estimates of
    the same record, in scaled units; the gain is then drawn towards Riccati's. With 0 there is no
    guide. Not of Adam's."""
    transfer: bool = False
    """Whether the gain is meant for other records, too: x̂ then leaves x̂₀ as fast as Riccati's gain
    takes it, and not by a gain that fits this record alone. Needs the guide."""
    gain_penalty: float = 0.1
    """Weight in the loss of the gain's squared departure from the guide's, or from zero without
    one, over its size and ten units of state, output and time; 1e-3 is a good one without a guide.
    Not of Adam's."""
    learning_rate: float = 1e-3
    """Step of Adam; constant."""
    optimiser: Optimiser = "ssbroyden"
    """Method that minimises the loss: Adam, on samples; or self-scaled Broyden, in scaled
    quantities."""
    iterations: int = 3000
    """Most iterations."""
    patience: int = 300
    """Iterations without a lower training loss after which training stops."""
    improvement: float = 0.02
    """How much lower the loss has to be for the patience to begin anew, relative to it."""
    train_fraction: float = 1.0
    """Part of the samples that Adam trains on; the others only measure the held-out loss."""
    points: int = 300
    """Most samples that self-scaled Broyden looks at, five times as many if they are noisy."""
    dtype: Precision = "float64"
    """Precision."""
    device: Device = "auto"
    """Where self-scaled Broyden trains on many records: at once on a GPU, or one after another on
    the CPU; ``auto`` takes a GPU if there is one. A single record is always trained on the CPU."""
    checkpoint_every: int = 200
    """Iterations from one checkpoint to the next."""
    log_every: int = 20
    """Iterations from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        self.check_shared()
        Architecture(1, 1, self.depth, self.width, self.activation, self.dtype)
        check_whole(self, ("iterations", "patience"))
        for name in ("w0", "w_ode", "w_y", "guide", "gain_penalty"):
            check_setting(self, name, "a number of at least 0", lambda v: 0 <= v < math.inf)
        check_setting(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        check_setting(
            self, "improvement", "a number of at least 0 and under 1", lambda v: 0 <= v < 1
        )
        check_setting(self, "train_fraction", "a number over 0 and at most 1", lambda v: 0 < v <= 1)
        check_choice(self, "optimiser", get_args(Optimiser))
        check_choice(self, "device", get_args(Device))
        if self.optimiser == "ssbroyden":
            check_whole(self, ("points",), least=10)
            check_setting(self, "dtype", "float64 with ssbroyden", lambda v: v == "float64")
            check_setting(self, "train_fraction", "1.0 with ssbroyden", lambda v: v == 1)
        if not self.guide:
            check_setting(self, "transfer", "False without a guide", lambda v: v is False)
        if self.optimiser == "adam":
            for name in ("guide", "gain_penalty"):
                check_setting(self, name, "0 with adam", lambda v: v == 0)


def fast() -> PinnObsConfig:
    """A small network in scaled quantities, guided by a smoother; self-scaled Broyden."""
    return PinnObsConfig()


def transfer() -> PinnObsConfig:
    """The fast recipe with a gain that is meant for other records, too, and so the aim."""
    return PinnObsConfig(transfer=True, gain_penalty=0.3)


def paper() -> PinnObsConfig:
    """The paper's recipe ("Ablation studies"): Adam on part of the samples."""
    return PinnObsConfig(
        depth=9,
        optimiser="adam",
        iterations=200_000,
        patience=20_000,
        improvement=0.0,
        train_fraction=0.6,
        points=0,
        guide=0.0,
        gain_penalty=0.0,
        dtype="float32",
        checkpoint_every=1000,
        log_every=100,
    )
