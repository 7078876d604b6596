"""The settings of the trainer of shared gains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

from pinnobs_gym.estimation.learned.gain_network import Variant
from pinnobs_gym.training.settings import TrainingConfig, check_choice, check_setting, check_whole


@dataclass(frozen=True)
class PinnGainConfig(TrainingConfig):
    """The recipe of a gain shared by all episodes."""

    may_change = ("iterations",)

    variant: Variant = "kalman"
    """A network that corrects a Kalman gain, or a recurrent network that gives the gain alone."""
    episodes: int = 192
    """Records that are learned from, those held out among them."""
    held_out: int = 48
    """Records that only decide which weights are kept."""
    width: int = 32
    """Neurons in each of the two hidden layers, or in the recurrent unit."""
    iterations: int = 350
    """Most iterations, each one chunk of all streams."""
    streams: int = 128
    """Streams that are run side by side."""
    chunk: int = 50
    """Samples over which errors are propagated back."""
    learning_rate: float = 3e-3
    """Step of Adam, after a short warm-up constant; the weights that count are a moving average."""
    consistency: float = 0.1
    """Weight of the likelihood of the errors under the covariance, beside their size."""
    check_every: int = 25
    """Iterations from one look at the records held out to the next."""
    checkpoint_every: int = 50
    """Iterations from one checkpoint to the next."""
    log_every: int = 5
    """Iterations from one point of the logged curves to the next."""

    @property
    def records(self) -> int:
        return self.episodes

    def __post_init__(self) -> None:
        self.check_shared()
        check_choice(self, "variant", get_args(Variant))
        whole = ("width", "iterations", "streams", "chunk", "held_out", "check_every")
        check_whole(self, whole)
        expected = f"a whole number over held_out={self.held_out}"
        check_setting(self, "episodes", expected, lambda v: v == int(v) > self.held_out)
        check_setting(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        check_setting(self, "consistency", "a number of at least 0", lambda v: 0 <= v < math.inf)
