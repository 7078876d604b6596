"""The settings of the trainer of shared gains."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

from pinnobs_gym.estimation.learned.gain_network import Variant
from pinnobs_gym.training.loop import expect


@dataclass(frozen=True)
class Config:
    """The recipe of a gain shared by all episodes."""

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
    seed: int = 0
    """What the weights, the streams and their noise are drawn from."""
    budget: float | None = None
    """CPU seconds after which training stops, those before a resumption included."""
    check_every: int = 25
    """Iterations from one look at the records held out to the next."""
    checkpoint_every: int = 50
    """Iterations from one checkpoint to the next."""
    log_every: int = 5
    """Iterations from one point of the logged curves to the next."""

    def __post_init__(self) -> None:
        known = get_args(Variant)
        expect(self, "variant", " or ".join(known), lambda v: v in known)
        whole = ("width", "iterations", "streams", "chunk", "held_out")
        for name in (*whole, "check_every", "checkpoint_every", "log_every"):
            expect(self, name, "a whole number of at least 1", lambda v: v == int(v) and v >= 1)
        least = self.held_out + 1
        expect(
            self,
            "episodes",
            f"a whole number over held_out={self.held_out}",
            lambda v: v == int(v) >= least,
        )
        expect(self, "seed", "a whole number of at least 0", lambda v: v == int(v) and v >= 0)
        expect(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        expect(self, "consistency", "a number of at least 0", lambda v: 0 <= v < math.inf)
        expect(self, "budget", "None or positive seconds", lambda v: v is None or v > 0)
