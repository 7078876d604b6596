"""Settings of the trainer of shared gains."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pinnobs_gym.estimation.learned.gain_network import Variant
from pinnobs_gym.training.settings import TrainingConfig, check_setting, check_whole


@dataclass(frozen=True)
class PinnGainConfig(TrainingConfig):
    """Settings of a gain shared by all episodes."""

    may_change = ("iterations",)

    variant: Variant = "kalman"
    """A network that corrects a Kalman gain (kalman), or a recurrent network (gru)."""
    episodes: int = 192
    """Number of records, including the held-out ones."""
    held_out: int = 48
    """Number of records held out for validation."""
    width: int = 32
    """Neurons in each of the two hidden layers, or in the recurrent unit."""
    iterations: int = 350
    """Largest number of iterations, each of one chunk of all streams."""
    streams: int = 128
    """Number of streams that run in parallel."""
    chunk: int = 50
    """Samples over which errors are backpropagated in time."""
    learning_rate: float = 3e-3
    """Step size of Adam, constant after a short warm-up."""
    consistency: float = 0.1
    """Weight of the negative log-likelihood of the errors under the covariance in the loss."""
    check_every: int = 25
    """Iterations between validations."""
    checkpoint_every: int = 50
    """Iterations between checkpoints."""
    log_every: int = 5
    """Iterations between points of the logged curves."""

    @property
    def records(self) -> int:
        return self.episodes

    def for_records(self, number: int) -> PinnGainConfig:
        """Return the settings for a number of records. Those held out are as many as set or, if
        that is more than half of them, a quarter."""
        if number < 2:
            raise ValueError(
                f"{number} log is given; pinn_gain learns from at least 2, one of them held out"
            )
        held_out = self.held_out if 2 * self.held_out <= number else max(1, number // 4)
        return replace(self, episodes=number, held_out=held_out)

    def __post_init__(self) -> None:
        self.check_shared()
        whole = ("width", "iterations", "streams", "chunk", "held_out", "check_every")
        check_whole(self, whole)
        expected = f"a whole number over held_out={self.held_out}"
        check_setting(self, "episodes", expected, lambda v: v == int(v) > self.held_out)
        check_setting(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        check_setting(self, "consistency", "a number of at least 0", lambda v: 0 <= v < math.inf)
