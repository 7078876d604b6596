"""The model that a command applies to sensor logs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from difflib import get_close_matches
from typing import Any

from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.simulation.augmented import augmented, with_constants
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.system import Setup, System, independent, is_number
from pinnobs_gym.systems import SYSTEMS

TOLERANCE = 0.1
"""Standard deviation of an unknown parameter over its value in the model, where none is given."""


def own_model(
    name: str,
    *,
    noise_std: tuple[float, ...] = (),
    process_noise: tuple[float, ...] = (),
    xhat0: tuple[float, ...] | None = None,
    P0_std: tuple[float, ...] | None = None,
    also: Sequence[str] = (),
) -> tuple[System, Setup]:
    """Return a system, which is registered, and its benchmark setup with what a user says of a log.

    Args:
        name: name or ``module:Class`` of the system.
        noise_std: standard deviations of the output noise, one for all outputs or one for each; the
            setup's if empty.
        process_noise: those of the process noise of the system's own states, as
            `Setup.process_noise`; the setup's if empty.
        xhat0: initial estimate of the system's own states; the setup's if None.
        P0_std: its standard deviations; the setup's if None.
        also: unknown constants as further states (`pinnobs_gym.simulation.augmented.augmented`),
            ``NAME=mean,std`` each: a parameter, ``bias_<output>`` or ``disturbance_<state>``. A
            parameter's ``NAME`` alone has the model's value as mean, and `TOLERANCE` of it as
            standard deviation.

    Raises:
        ValueError: in one line that names the value and what was expected.
    """
    env_id(name)  # checks and registers the user's own system
    level = _level(noise_std) if noise_std else None
    system, setup = SYSTEMS.resolve(name).configured(noise_std=level)
    if process_noise:
        setup = replace(setup, process_noise=_level(process_noise))
        system.noise(setup.noise_std, setup.process_noise)
    if xhat0:
        setup = replace(setup, xhat0=xhat0)
    if P0_std:
        setup = replace(setup, P0=independent(*P0_std))
    if not also:
        return system, setup
    larger: Any = augmented(system, **_unknowns(system, also))
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
        mean, std = map(float, values.split(","))
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
