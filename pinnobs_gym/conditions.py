"""Conditions: ways in which an episode departs from what its setup says."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pinnobs_gym.system import Setup, System, vector


def noise_scale(system: System, setup: Setup) -> np.ndarray:
    """The output noise (ny,) that conditions multiply: the setup's, or where that is zero the
    benchmark's."""
    own = vector(setup.noise_std, system.ny, "noise_std")
    benchmark = vector(system.setups["benchmark"].noise_std, system.ny, "noise_std")
    return np.where(own > 0, own, benchmark)


@dataclass(frozen=True)
class Condition:
    """What changes in an episode. The base class changes nothing.

    Each method gets one random generator per episode and must draw from it in the same way however
    many episodes there are, so that an episode does not depend on those simulated with it.
    """

    def setup(self, system: System, setup: Setup) -> Setup:
        """The setup that is played; estimators are told of it."""
        return setup

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        """The true plant, its parameters numbers or arrays (batch,); estimators keep the model."""
        return system

    def outputs(
        self, y: np.ndarray, noise_std: np.ndarray, rngs: Sequence[np.random.Generator]
    ) -> np.ndarray:
        """What becomes of the noisy outputs (num_samples, batch, ny) on the way, a new array;
        ``noise_std`` (ny,) is the noise that `noise_scale` gives."""
        return y


@dataclass(frozen=True)
class Noise(Condition):
    """Output noise of another strength, times that of `noise_scale`; the estimators are told."""

    factor: float

    def setup(self, system: System, setup: Setup) -> Setup:
        std = self.factor * noise_scale(system, setup)
        return replace(setup, noise_std=tuple(std.tolist()))


@dataclass(frozen=True)
class Dropouts(Condition):
    """Samples missing at random, each with the same probability."""

    probability: float

    def outputs(
        self, y: np.ndarray, noise_std: np.ndarray, rngs: Sequence[np.random.Generator]
    ) -> np.ndarray:
        lost = [rng.random((len(y), y.shape[-1])) < self.probability for rng in rngs]
        return np.where(np.stack(lost, axis=1), np.nan, y)


@dataclass(frozen=True)
class Outliers(Condition):
    """Some samples off by a Gaussian error many times the noise of `noise_scale`."""

    probability: float
    strength: float

    def outputs(
        self, y: np.ndarray, noise_std: np.ndarray, rngs: Sequence[np.random.Generator]
    ) -> np.ndarray:
        shape = (len(y), y.shape[-1])
        std = self.strength * noise_std
        errors = [
            (rng.random(shape) < self.probability) * rng.standard_normal(shape) for rng in rngs
        ]
        return y + np.stack(errors, axis=1) * std


@dataclass(frozen=True)
class LoadStep(Condition):
    """The load torque of a motor steps at 0.6 s to a value uniform in 0 to 40 N·m."""

    time: float = 0.6
    highest: float = 40.0

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        if "load_step_torque" not in {f.name for f in fields(system)}:
            raise ValueError(
                f"condition 'load_step' needs a plant with a load torque; "
                f"{type(system).__name__} has none"
            )
        torque = np.array([rng.uniform(0.0, self.highest) for rng in rngs])
        changes = {"load_step_time": self.time, "load_step_torque": torque}
        return replace(system, **changes)


@dataclass(frozen=True)
class Combined(Condition):
    """Several conditions at once, applied in order."""

    parts: tuple[Condition, ...]

    def setup(self, system: System, setup: Setup) -> Setup:
        for part in self.parts:
            setup = part.setup(system, setup)
        return setup

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        for part in self.parts:
            system = part.plant(system, rngs)
        return system

    def outputs(
        self, y: np.ndarray, noise_std: np.ndarray, rngs: Sequence[np.random.Generator]
    ) -> np.ndarray:
        for part in self.parts:
            y = part.outputs(y, noise_std, rngs)
        return y


CONDITIONS: dict[str, Condition] = {
    "nominal": Condition(),
    "load_step": LoadStep(),
    **{f"noise{factor:g}": Noise(factor) for factor in (0, 0.1, 0.5, 5, 15)},
    **{f"dropout{percent}": Dropouts(percent / 100) for percent in (10, 30, 50)},
    "outliers": Outliers(probability=0.05, strength=50.0),
}
"""The conditions by name; ``a+b`` is both."""


def parse_condition(name: str) -> Condition:
    """The condition of that name, or several joined by ``+``.

    Raises:
        ValueError: listing the known ones, if one is unknown.
    """
    parts = name.split("+")
    for part in parts:
        if part not in CONDITIONS:
            raise ValueError(f"unknown condition {part!r}; known are {', '.join(CONDITIONS)}")
    if len(parts) == 1:
        return CONDITIONS[name]
    return Combined(tuple(CONDITIONS[part] for part in parts))
