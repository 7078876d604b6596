"""Settings and presets of the trainer of PINN-Obs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

from pinnobs_gym.estimation.learned.mlp import Activation, Architecture, Precision
from pinnobs_gym.training.settings import TrainingConfig, check_setting, check_whole

Optimiser: TypeAlias = Literal["adam", "ssbroyden", "levenberg_marquardt"]
"""Method of minimisation: Adam of the paper, self-scaled Broyden of the fast recipe, or
Levenberg-Marquardt of the posterior."""
Device: TypeAlias = Literal["auto", "cpu", "cuda"]
"""Device of trainings on many records; ``auto`` takes a GPU if there is one."""


@dataclass(frozen=True)
class PinnObsConfig(TrainingConfig):
    """Settings of PINN-Obs; by default those of `guided`, see also `plain` and `paper`."""

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
    """Weight of the scaled squared deviation of x̂ from the guide, a Kalman smoother's estimates of
    the same record; 0 is the paper's loss without a guide, as Adam and the
    posterior require."""
    transfer: bool = False
    """Whether the gain is meant for other records, too, so that x̂ leaves x̂₀ only as fast as the
    Riccati gain allows; needs the guide."""
    gain_penalty: float = 0.1
    """Weight of the scaled squared deviation of the gain from the guide's, or from zero without a
    guide; 0 with Adam and the posterior."""
    learning_rate: float = 1e-3
    """Constant step size of Adam."""
    optimiser: Optimiser = "ssbroyden"
    """Minimiser of the loss: Adam (the paper's recipe), self-scaled Broyden (the fast one), or
    Levenberg-Marquardt (the posterior)."""
    iterations: int = 3000
    """Largest number of iterations."""
    patience: int = 300
    """Iterations without a sufficiently lower training loss after which training stops."""
    improvement: float = 0.02
    """Relative decrease of the loss that resets the patience."""
    train_fraction: float = 1.0
    """Fraction of the samples that Adam trains on; the rest are for the validation loss."""
    points: int = 300
    """Approximate number of samples that self-scaled Broyden uses; five times as many if noisy."""
    dtype: Precision = "float64"
    """Precision of the network."""
    device: Device = "auto"
    """Device of self-scaled Broyden on many records: all at once on a GPU, or one after another on
    the CPU; ``auto`` takes a GPU if there is one."""
    checkpoint_every: int = 200
    """Iterations between checkpoints."""
    log_every: int = 20
    """Iterations between points of the logged curves."""

    @property
    def recipe(self) -> str:
        if self.optimiser == "levenberg_marquardt":
            return "posterior"
        if self.guide:
            return "guided by a smoother"
        return "paper's recipe" if self.optimiser == "adam" else "paper's loss"

    @property
    def knows(self) -> tuple[str, ...]:
        if self.optimiser == "adam":
            return ()
        return ("noise", "a smoother of its training record") if self.guide else ("noise",)

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
        check_whole(self, ("points",), least=10 if self.optimiser == "ssbroyden" else 0)
        if self.optimiser != "adam":
            by = f"with {self.optimiser}"
            check_setting(self, "dtype", f"float64 {by}", lambda v: v == "float64")
            check_setting(self, "train_fraction", f"1.0 {by}", lambda v: v == 1)
        if not self.guide:
            check_setting(self, "transfer", "False without a guide", lambda v: v is False)
        if self.optimiser != "ssbroyden":
            for name in ("guide", "gain_penalty"):
                check_setting(self, name, f"0 with {self.optimiser}", lambda v: v == 0)
        if self.optimiser == "levenberg_marquardt":
            self._check_posterior()

    def _check_posterior(self) -> None:
        """Check the settings of the posterior, whose weights are those of a probability."""
        by = f"with {self.optimiser}"
        for name in ("w0", "w_ode", "w_y"):
            check_setting(self, name, f"1 {by}, a probability", lambda v: v == 1)
        check_setting(self, "depth", f"1 {by}", lambda v: v == 1)
        check_setting(self, "activation", f"tanh {by}", lambda v: v == "tanh")
        check_setting(self, "points", f"0 {by}", lambda v: v == 0)


def guided() -> PinnObsConfig:
    """The fast recipe, guided by a Kalman smoother of the same record, which is not the paper's."""
    return PinnObsConfig()


def plain() -> PinnObsConfig:
    """The fast recipe with the paper's loss, a small penalty on the gain, and no smoother."""
    # Of those tried, the weights with the least median RMSE over the six paper setups.
    return PinnObsConfig(guide=0.0, gain_penalty=1e-2, w_y=100.0)


def transfer() -> PinnObsConfig:
    """The guided fast recipe with a gain that is meant for other records, too."""
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


def posterior() -> PinnObsConfig:
    """The most probable path of a network, given the outputs, the prior and the noise, and its
    covariance; no smoother."""
    return PinnObsConfig(
        depth=1,
        width=200,
        optimiser="levenberg_marquardt",
        iterations=100,
        patience=100,
        points=0,
        guide=0.0,
        gain_penalty=0.0,
        checkpoint_every=10,
        log_every=1,
    )
