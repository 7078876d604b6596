"""What a plant may have that an estimator does not take, and the refusal of such a plant."""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np

from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import System

FEATURES = {
    "maps": "maps x⁺ = f(k, x, u)",
    "stiff": "stiff plants",
    "own_flow": "plants with a flow of their own",
    "process_noise": "known process noise",
    "full_noise": "correlated output noise",
    "sampled_noise": "output noise that differs by sample",
    "output_period": "outputs with a period",
    "state_period": "states with a period",
    "bounds": "bounds of states",
    "held_input": "measured inputs that are held between samples",
}
"""What a plant, its noise or its record may have beyond the usual, by name."""
EVERYTHING = frozenset(FEATURES)
"""The names of all `FEATURES`."""


class Taker(Protocol):
    """An estimator or a trainer, which says what a plant may have."""

    takes: ClassVar[frozenset[str]]
    """Names of `FEATURES`."""


class NotTaken(ValueError):
    """A plant has what an estimator does not take; the message is one line."""


def features(system: System, noise: Noise) -> list[str]:
    """Return the names of the `FEATURES` that a plant with this noise has, in their order."""
    beside = ~np.eye(system.ny, dtype=bool)
    found = {
        "maps": system.discrete,
        "stiff": system.stiff,
        "own_flow": system.own_flow,
        "process_noise": noise.stochastic,
        "full_noise": bool(noise.R(0.0)[beside].any()),
        "sampled_noise": noise.samples is not None,
        "output_period": system.output_period is not None,
        "state_period": system.state_period is not None,
        "bounds": system.state_low is not None or system.state_high is not None,
        "held_input": system.measured_input and system.nu > 0 and system.input_hold == "previous",
    }
    return [name for name in FEATURES if found[name]]


def lacking(cls: type[Taker], system: System, noise: Noise) -> list[str]:
    """Return the names of the `FEATURES` that a plant has and an estimator or a trainer does not
    take."""
    return [name for name in features(system, noise) if name not in cls.takes]


def check_taken(cls: type[Taker], system: System, noise: Noise) -> None:
    """Check that an estimator or a trainer takes what a plant has.

    Raises:
        NotTaken: in one line that names the class, what the plant has and what the class takes.
    """
    missing = lacking(cls, system, noise)
    if missing:
        what = ", ".join(FEATURES[name] for name in missing)
        taken = ", ".join(FEATURES[name] for name in FEATURES if name in cls.takes)
        raise NotTaken(
            f"{cls.__name__} does not take {type(system).__name__}: it takes no {what}; of what a "
            f"plant may have it takes {taken or 'nothing'}"
        )
