"""Conditions of the measurement: output noise, sample time, missing or late samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.simulation.conditions.base import Condition, Outputs, Unknowns, noise_scale
from pinnobs_gym.simulation.system import Setup, System


@dataclass(frozen=True)
class Noise(Condition):
    """Output noise multiplied by a factor, relative to `noise_scale`."""

    factor: float
    known_to_estimators = "its strength"

    @property
    def reference(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """False without output noise."""
        return self.factor > 0

    @property
    def summary(self) -> str:
        return f"output noise × {self.factor:g}"

    def setup(self, system: System, setup: Setup) -> Setup:
        if np.ndim(setup.noise_std) < 2:
            std = self.factor * noise_scale(system, setup)
            return replace(setup, noise_std=tuple(std.tolist()))
        G = self.factor * np.asarray(setup.noise_std, dtype=float)
        return replace(setup, noise_std=tuple(map(tuple, G.tolist())))


@dataclass(frozen=True)
class SampleTime(Condition):
    """Time between samples multiplied by a factor, with the duration unchanged."""

    factor: float
    known_to_estimators = "the sample times"

    @property
    def summary(self) -> str:
        return f"time between samples × {self.factor:g}"

    def setup(self, system: System, setup: Setup) -> Setup:
        changed = replace(setup, dt=self.factor * setup.dt)
        system.check_times(changed)
        return changed


@dataclass(frozen=True)
class Outliers(Condition):
    """Some outputs disturbed by a Gaussian error many times larger than the noise of
    `noise_scale`."""

    probability: float
    strength: float
    reference = False

    @property
    def summary(self) -> str:
        return f"{100 * self.probability:g} % of the outputs off by {self.strength:g} σ"

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        shape = (len(sent.y), sent.y.shape[-1])
        errors = [
            (rng.random(shape) < self.probability) * rng.standard_normal(shape) for rng in rngs
        ]
        return sent.y + np.stack(errors, axis=1) * (self.strength * sent.noise_std)

    def output_errors(self, scale: np.ndarray) -> tuple[tuple[float, np.ndarray], ...]:
        return ((self.probability, self.strength * scale),)


@dataclass(frozen=True)
class Delay(Condition):
    """Outputs delayed by d samples: sample k holds the output of sample k − d, and the first d
    samples are missing. Inputs are not delayed."""

    samples: int
    reference = False
    loses_outputs = True

    @property
    def summary(self) -> str:
        return f"outputs {self.samples} sample{'s' * (self.samples > 1)} late"

    def setup(self, system: System, setup: Setup) -> Setup:
        if setup.num_steps <= self.samples:
            raise ValueError(
                f"condition 'delay{self.samples}' leaves no output in {setup.num_steps} sample(s)"
            )
        return setup

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        return self.arrival(sent.y)

    def arrival(self, y: np.ndarray) -> np.ndarray:
        late = np.full_like(y, np.nan)
        late[self.samples :] = y[: -self.samples]
        return late

    def unknowns(self, system: System, setup: Setup) -> tuple[Unknowns, ...]:
        """The delay in s. It is the same in all episodes, and zero in the model."""
        return (_Lateness((self.samples * setup.dt,)),)


@dataclass(frozen=True)
class _Lateness(Unknowns):
    """A time τ in s by which outputs are late: y(t) = h(t − τ, x(t − τ), u(t − τ))."""

    def output_slopes(
        self, system: System, t: np.ndarray, x: np.ndarray, u: np.ndarray
    ) -> np.ndarray:
        """Return −dh/dt along the trajectory: the central difference along its tangent, whose error
        is of second order in a step of a thousandth of the delay. Of a map, it is the change of
        the output in a step."""
        if system.discrete:
            after = system.h(t + 1, system.f(t, x, u), np.asarray(system.input(t + 1)))
            return (system.h(t, x, u) - after)[..., None]
        step, rate = 1e-3 * self.std[0], system.f(t, x, u)
        earlier, later = (
            system.h(t + s, x + s * rate, np.asarray(system.input(t + s))) for s in (-step, step)
        )
        return ((earlier - later) / (2 * step))[..., None]


@dataclass(frozen=True)
class Dropouts(Condition):
    """Outputs missing at random, each with the same probability."""

    probability: float
    known_to_estimators = "which are missing"
    loses_outputs = True

    @property
    def summary(self) -> str:
        return f"{100 * self.probability:g} % of the outputs missing"

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        shape = (len(sent.y), sent.y.shape[-1])
        lost = [rng.random(shape) < self.probability for rng in rngs]
        return np.where(np.stack(lost, axis=1), np.nan, sent.y)


@dataclass(frozen=True)
class Gap(Condition):
    """An interval without outputs at a random time of the episode: 1 s long, or a fifth of an
    episode shorter than 5 s."""

    seconds: float = 1.0
    largest_part: float = 0.2
    known_to_estimators = "which are missing"
    loses_outputs = True

    @property
    def summary(self) -> str:
        return (
            f"no output for {self.seconds:g} s (of a map: as many steps), at most "
            f"{100 * self.largest_part:g} % of the time"
        )

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        t = sent.t
        length = min(self.seconds, self.largest_part * float(t[-1] - t[0]))
        first = np.array([rng.uniform(t[0], t[-1] - length) for rng in rngs])
        lost = (t[:, None] >= first) & (t[:, None] < first + length)
        return np.where(lost[..., None], np.nan, sent.y)
