"""Conditions: changes of an episode relative to its setup."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np

from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.conditions.base import Condition, Outputs, Unknowns
from pinnobs_gym.simulation.conditions.measurement import (
    Delay,
    Dropouts,
    Gap,
    Noise,
    Outliers,
    SampleTime,
)
from pinnobs_gym.simulation.conditions.plant import LoadStep, Mismatch, ProcessNoise
from pinnobs_gym.simulation.conditions.start import FarGuess, GivenPoorPrior, OutsideSet
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.simulation.values import shortly


@dataclass(frozen=True)
class Combined(Condition):
    """Several conditions together, applied in order."""

    parts: tuple[Condition, ...]

    @property
    def known_to_estimators(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What estimators know of the parts."""
        known = dict.fromkeys(part.known_to_estimators for part in self.parts)
        return ", ".join(what for what in known if what != "nothing")

    @property
    def reference(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the Cramér-Rao reference applies under every part."""
        return all(part.reference for part in self.parts)

    @property
    def loses_outputs(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether outputs may be missing under any part."""
        return any(part.loses_outputs for part in self.parts)

    @property
    def summary(self) -> str:
        return "; ".join(part.summary for part in self.parts)

    def setup(self, system: System, setup: Setup) -> Setup:
        for part in self.parts:
            setup = part.setup(system, setup)
        return setup

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        for part in self.parts:
            x0 = part.starts(x0, inside)
        return x0

    def start_log_density(
        self,
        x0: np.ndarray,
        log_density: Callable[[np.ndarray], np.ndarray],
        inside: Callable[[np.ndarray], np.ndarray],
    ) -> np.ndarray:
        for part in self.parts:
            log_density = partial(part.start_log_density, log_density=log_density, inside=inside)
        return log_density(x0)

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        for part in self.parts:
            system = part.plant(system, rngs)
        return system

    def plants(self, system: System) -> tuple[System, ...]:
        found = (system,)
        for part in self.parts:
            found = tuple(plant for each in found for plant in part.plants(each))
        return found

    def arrival(self, y: np.ndarray) -> np.ndarray:
        for part in self.parts:
            y = part.arrival(y)
        return y

    def output_errors(self, scale: np.ndarray) -> tuple[tuple[float, np.ndarray], ...]:
        return tuple(law for part in self.parts for law in part.output_errors(scale))

    def unknowns(self, system: System, setup: Setup) -> tuple[Unknowns, ...]:
        return tuple(each for part in self.parts for each in part.unknowns(system, setup))

    def process_noise(self, system: System, setup: Setup) -> np.ndarray:
        return np.concatenate([part.process_noise(system, setup) for part in self.parts], axis=1)

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        for part in self.parts:
            sent = replace(sent, y=part.outputs(sent, rngs))
        return sent.y


CONDITIONS: dict[str, Condition] = {
    "nominal": Condition(),
    **{f"noise{factor:g}": Noise(factor) for factor in (0, 0.1, 0.5, 5, 15)},
    **{f"dt{factor:g}": SampleTime(factor) for factor in (0.5, 2, 5)},
    "poor_prior": GivenPoorPrior(),
    "xhat0_far": FarGuess(),
    "x0_outside": OutsideSet(),
    **{f"mismatch{percent}": Mismatch(percent / 100) for percent in (10, 30)},
    "load_step": LoadStep(),
    "process_noise1e-3": ProcessNoise(1e-3),
    "process_noise1e-2": ProcessNoise(1e-2),
    "outliers": Outliers(probability=0.05, strength=50.0),
    **{f"delay{samples}": Delay(samples) for samples in (1, 2, 3, 4, 5)},
    **{f"dropout{percent}": Dropouts(percent / 100) for percent in (10, 30, 50)},
    "gap": Gap(),
}
"""The conditions by name, in the order in which they are applied; ``a+b`` combines two."""


def canonical_name(name: str) -> str:
    """Return the canonical name of a condition: its parts in the order in which they are applied,
    with ``nominal`` only on its own.

    Raises:
        ValueError: listing the known conditions, if a part is unknown; naming the parts, if two are
            of the same kind.
    """
    named = name.split("+") if isinstance(name, str) else [name]
    for part in named:
        if not isinstance(part, str) or part not in CONDITIONS:
            raise ValueError(
                f"unknown condition {shortly(part)}; known are {', '.join(CONDITIONS)}"
                f"{did_you_mean(part, CONDITIONS)}"
            )
    named.sort(key=list(CONDITIONS).index)
    for first, second in pairwise(named):
        if type(CONDITIONS[first]) is type(CONDITIONS[second]):
            raise ValueError(
                f"condition {name!r}: {first!r} and {second!r} change the same; name one"
            )
    return "+".join(part for part in named if part != "nominal") or "nominal"


def parse_condition(name: str) -> Condition:
    """Return the condition of that name, or of several names joined by ``+`` in any order.

    Raises:
        ValueError: as `canonical_name` does.
    """
    parts = tuple(CONDITIONS[part] for part in canonical_name(name).split("+"))
    return parts[0] if len(parts) == 1 else Combined(parts)


def fitting(system: System, setup: Setup) -> list[str]:
    """Return the names of all conditions that apply to a system in a setup."""
    names = []
    for name, condition in CONDITIONS.items():
        try:
            condition.setup(system, setup)
            condition.plant(system, ())
        except ValueError:
            continue
        names.append(name)
    return names
