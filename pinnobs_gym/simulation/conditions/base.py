"""The base class of conditions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from pinnobs_gym.simulation.noise import noise_std
from pinnobs_gym.simulation.system import Setup, System


def noise_scale(system: System, setup: Setup) -> np.ndarray:
    """Return the output noise (ny,) that conditions multiply: the setup's, or the benchmark's where
    the setup has none."""
    levels = setup.noise_std, system.setups["benchmark"].noise_std
    own, benchmark = (noise_std(level, system.ny, "noise_std") for level in levels)
    return np.where(own > 0, own, benchmark)


@dataclass(frozen=True)
class Outputs:
    """Noisy outputs of a batch of episodes."""

    t: np.ndarray
    """Sample times in s, shape (num_samples,)."""
    y: np.ndarray
    """Shape (num_samples, batch, ny)."""
    noise_std: np.ndarray
    """Noise standard deviations from `noise_scale`, shape (ny,)."""


@dataclass(frozen=True)
class Unknowns:
    """Numbers that a condition changes and estimators are not told, as deviations from what the
    model says. Without deviations, the plant and its outputs are the model's.

    The base class has numbers without any effect; a subclass overrides what they act on.
    """

    std: tuple[float, ...]
    """Root mean square of each deviation under the condition's law, above 0."""

    def plant(self, system: System, deviations: np.ndarray) -> System:
        """Return the system with these deviations, shape (batch, num_unknowns)."""
        return system

    def output_slopes(
        self, system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Return the derivative of received outputs with respect to each deviation, where there is
        none, beyond what follows from `plant`: shape (batch, ny, num_unknowns).

        Args:
            system: the model.
            t: times in s, shape (batch,).
            x: states at these times, shape (batch, nx).
            u: inputs at these times, shape (batch, nu).
        """
        return np.zeros((len(x), system.ny, len(self.std)))


@dataclass(frozen=True)
class Condition:
    """A change of an episode. The base class changes nothing.

    Methods that take random generators get one per episode. They must draw from each in the same
    way for any number of episodes, so that an episode does not depend on the others in its batch.
    """

    known_to_estimators: ClassVar[str] = "nothing"
    """What estimators know of the change."""
    reference: ClassVar[bool] = True
    """Whether the Cramér-Rao reference applies: the model, prior and noise known to the estimators,
    with the process noise, are those of these episodes."""
    loses_outputs: ClassVar[bool] = False
    """Whether outputs may be missing."""

    @property
    def summary(self) -> str:
        """The change in a few words."""
        return "nothing: the setup as it is"

    def setup(self, system: System, setup: Setup) -> Setup:
        """Return the setup that is played; it is known to estimators."""
        return setup

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """Return the changed initial states, given states (n, nx) of the setup's set; there may be
        fewer than n. ``inside`` returns which states (..., nx) belong to the set: bool (...)."""
        return x0

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        """Return the true plant, with parameters that are numbers or arrays (batch,). Estimators
        keep the model."""
        return system

    def unknowns(self, system: System, setup: Setup) -> tuple[Unknowns, ...]:
        """Return the numbers that estimators are not told, in the order in which they act on the
        plant; none if the condition changes only what is random anyway or what estimators know.

        `pinnobs_gym.scoring.identifiability` tells from them whether the outputs determine the
        state.

        Args:
            system: the model.
            setup: the setup that is played.
        """
        return ()

    def start_log_density(
        self,
        x0: np.ndarray,
        log_density: Callable[[np.ndarray], np.ndarray],
        inside: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        """Return the logarithm of the density of the changed initial states x0 (..., nx), up to a
        constant, (...). ``log_density`` is that of the setup's set, ``inside`` as in `starts`."""
        return log_density(x0)

    def plants(self, system: System) -> tuple[System, ...]:
        """Return the equally probable plants of which `plant` draws one.

        Raises:
            ValueError: in one line, if they cannot be listed.
        """
        return (system,)

    def arrival(self, y: np.ndarray) -> np.ndarray:
        """Return noiseless outputs (num_samples, ...) in the order in which they are received; NaN
        where there is none."""
        return y

    def output_errors(self, scale: np.ndarray) -> tuple[tuple[float, np.ndarray], ...]:
        """Return the law of errors that outputs have beyond their noise, each independently of the
        others: pairs of a probability and of standard deviations (ny,) of a Gaussian error. The
        remaining probability is that of no error.

        Args:
            scale: noise standard deviations from `noise_scale`, shape (ny,).
        """
        return ()

    def process_noise(self, system: System, setup: Setup) -> np.ndarray:
        """Return L (nx, m), in state units per √s, of process noise of the plant beyond that of
        the setup which is played; m is zero for none."""
        return np.zeros((system.nx, 0))

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        """Return the outputs as received: a new array of y's shape, in which NaN marks a missing
        output."""
        return sent.y
