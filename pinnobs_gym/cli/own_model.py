"""The model that a command applies to sensor logs."""

from __future__ import annotations

from dataclasses import replace

from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.system import Setup, System, independent
from pinnobs_gym.systems import SYSTEMS


def own_model(
    name: str,
    *,
    noise_std: tuple[float, ...] = (),
    process_noise: tuple[float, ...] = (),
    xhat0: tuple[float, ...] | None = None,
    P0_std: tuple[float, ...] | None = None,
) -> tuple[System, Setup]:
    """Return a system, which is registered, and its benchmark setup with what a user says of a log.

    Args:
        name: name or ``module:Class`` of the system.
        noise_std: standard deviations of the output noise, one for all outputs or one for each; the
            setup's if empty.
        process_noise: those of the process noise, as `Setup.process_noise`; the setup's if empty.
        xhat0: initial estimate; the setup's if None.
        P0_std: its standard deviations; the setup's if None.

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
    return system, setup


def _level(values: tuple[float, ...]) -> Level:
    """Return the standard deviations of a noise; a single one is that of all components."""
    return values[0] if len(values) == 1 else values
