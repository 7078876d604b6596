"""What a condition is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pinnobs_gym.simulation.system import Setup, System, vector


def noise_scale(system: System, setup: Setup) -> np.ndarray:
    """The output noise (ny,) that conditions multiply: the setup's, or where that is zero the
    benchmark's."""
    own = vector(setup.noise_std, system.ny, "noise_std")
    benchmark = vector(system.setups["benchmark"].noise_std, system.ny, "noise_std")
    return np.where(own > 0, own, benchmark)


@dataclass(frozen=True)
class Outputs:
    """Noisy outputs of some episodes."""

    t: np.ndarray
    """Sample times in s, shape (num_samples,)."""
    y: np.ndarray
    """Shape (num_samples, batch, ny)."""
    noise_std: np.ndarray
    """What `noise_scale` gives, shape (ny,)."""


@dataclass(frozen=True)
class Condition:
    """What changes in an episode. The base class changes nothing.

    Each method gets one random generator per episode and must draw from it in the same way however
    many episodes there are, so that an episode does not depend on those simulated with it.
    """

    known_to_estimators: ClassVar[str] = "nothing"
    """What estimators are told of it."""
    reference: ClassVar[bool] = True
    """Whether the Cramér-Rao reference of the model, the prior and the noise that estimators are
    told, and of the process noise, is that of these episodes."""

    @property
    def summary(self) -> str:
        """What it changes, in a few words."""
        return "nothing: the setup as it is"

    def setup(self, system: System, setup: Setup) -> Setup:
        """The setup that is played; estimators are told of it."""
        return setup

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """What becomes of initial states (n, nx) of the setup's set, or of as many of them as may
        be used; ``inside`` says which states (..., nx) belong to the set: bool (...)."""
        return x0

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        """The true plant, its parameters numbers or arrays (batch,); estimators keep the model."""
        return system

    def process_noise(self, system: System) -> np.ndarray | None:
        """Standard deviations (nx,) of white noise added to the state at every sample after the
        first, in state units; None for none."""
        return None

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        """What becomes of noisy outputs on the way: a new array of y's shape, in which NaN is a
        missing output."""
        return sent.y
