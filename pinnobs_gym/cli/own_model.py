"""The model that a command applies to sensor logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from typing import Any

from pinnobs_gym.cli.numbers import finite_or_inf
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.simulation.augmented import augmented, with_constants
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.system import Setup, System, independent
from pinnobs_gym.simulation.values import is_number
from pinnobs_gym.systems import SYSTEMS

TOLERANCE = 0.1
"""Standard deviation of an unknown parameter over its value in the model, where none is given."""


@dataclass(frozen=True)
class ModelOptions:
    """What is told of the model beside its equations."""

    noise_std: tuple[float, ...] = ()
    """Standard deviations of the output noise, one for all outputs or one for each; the
    benchmark's if not given."""
    process_noise: tuple[float, ...] = ()
    """Standard deviations of the process noise after one second (of a map: after one step), in
    state units per √s, one for all of the system's own states or one for each; the benchmark's if
    not given."""
    xhat0: tuple[float, ...] | None = None
    """Initial estimate of the system's own states; the benchmark's if not given."""
    P0_std: tuple[float, ...] | None = None
    """Its standard deviations; the benchmark's if not given."""
    also: tuple[str, ...] = ()
    """Unknown constants as further states: a parameter (its value in the model, with a tenth of it
    as standard deviation), or NAME=mean,std of a parameter, bias_OUTPUT, disturbance_STATE or
    rate_STATE."""

    def words(self) -> list[str]:
        """Return what was given, as words of a command line."""
        given = {
            "--noise-std": self.noise_std,
            "--process-noise": self.process_noise,
            "--xhat0": self.xhat0,
            "--P0-std": self.P0_std,
            "--also": self.also,
        }
        return [
            word
            for option, values in given.items()
            if values
            for word in (option, *(v if isinstance(v, str) else f"{v:.15g}" for v in values))
        ]

    def told(self, name: str) -> tuple[System, Setup]:
        """Return the system of a name or ``module:Class``, which is registered, and its benchmark
        setup, as told.

        Raises:
            ValueError: in one line that names the value and what was expected.
        """
        env_id(name)  # checks and registers the user's own system
        level = _level(self.noise_std) if self.noise_std else None
        system, setup = SYSTEMS.resolve(name).configured(noise_std=level)
        if self.process_noise:
            setup = replace(setup, process_noise=_level(self.process_noise))
            system.noise(setup.noise_std, setup.process_noise)
        for option, values in (("--xhat0", self.xhat0), ("--P0-std", self.P0_std)):
            if values is not None and len(values) != system.nx:
                raise ValueError(
                    f"{option} has {len(values)} number(s); expected {system.nx}, one for each of "
                    f"{', '.join(system.state_names)}"
                )
        if self.xhat0:
            setup = replace(setup, xhat0=self.xhat0)
        if self.P0_std:
            setup = replace(setup, P0=independent(*self.P0_std))
        if not self.also:
            return system, setup
        larger = augmented(system, **_unknowns(system, self.also))
        return larger, with_constants(larger, setup)


def _level(values: tuple[float, ...]) -> Level:
    """Return the standard deviations of a noise; a single one is that of all components."""
    return values[0] if len(values) == 1 else values


def _unknowns(system: System, also: Sequence[str]) -> dict[str, dict[str, Unknown]]:
    """Return the unknown constants that are named, by the arguments of `augmented`."""
    known = {name: ("parameters", name) for name in system.parameters}
    for kind, prefix, names in (
        ("output_bias", "bias_", system.output_names),
        ("disturbance", "disturbance_", system.state_names),
        ("rates", "rate_", system.state_names),
    ):
        for name in names:
            known.setdefault(prefix + name, (kind, name))
    found: dict[str, dict[str, Unknown]] = {}
    for text in also:
        name, equals, values = text.partition("=")
        name = name.strip()
        if name not in known:
            close = get_close_matches(name, known, 1)
            perhaps = f"; did you mean {close[0]}?" if close else ""
            raise ValueError(
                f"also={text!r}; expected NAME or NAME=mean,std with a name of "
                f"{', '.join(known)}{perhaps}"
            )
        kind, own = known[name]
        constants = found.setdefault(kind, {})
        if own in constants:
            raise ValueError(f"also={text!r}: {name} is given twice")
        value = getattr(system, name) if kind == "parameters" else None
        constants[own] = _given(text, values) if equals else _of_model(text, value)
    return found


def _given(text: str, values: str) -> Unknown:
    """Return the constant of a mean and a standard deviation."""
    try:
        mean, std = map(finite_or_inf, values.split(","))
        return Unknown(mean, std)
    except ValueError:
        raise ValueError(
            f"also={text!r}; expected NAME=mean,std: two numbers, the second above 0"
        ) from None


def _of_model(text: str, value: Any) -> Unknown:
    """Return the constant whose mean is the value that a model has; None if it has none."""
    if not is_number(value) or not value:
        reason = (
            "the model has no value of it" if value is None else f"it is {value!r} in the model"
        )
        raise ValueError(f"also={text!r}; expected {text}=mean,std, as {reason}")
    return Unknown(float(value), TOLERANCE * abs(float(value)))
