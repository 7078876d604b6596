"""Handling of arguments common to the single and the vectorised environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.system import System

NOT_FINITE_REWARD = -1e4
"""Reward of an action that is not finite, which ends the episode."""


def reward_weights(system: System) -> np.ndarray:
    """Return the weight of each squared error in the negative reward."""
    return 1 / (np.asarray(system.scale, dtype=float) ** 2 * system.nx)


@np.errstate(over="ignore", invalid="ignore")  # half the time of a with statement
def reward_of(system: System, estimates: np.ndarray, x: np.ndarray, weights: np.ndarray) -> Any:
    """Return the rewards (...) of estimates (..., nx) of the states x (..., nx)."""
    error = system.state_residual(estimates, x)
    return -(error * error).dot(weights)


def errors_of(system: System) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return the function of an estimate (nx,) and the state (nx,) whose result is the error."""
    if system.state_period is None:
        return system.state_residual
    # Half a turn about zero is not defined for an estimate that is not finite.
    return np.errstate(over="ignore", invalid="ignore")(system.state_residual)


def seeds_of(rng: np.random.Generator) -> np.random.SeedSequence:
    """Return the seed sequence of a generator made by Gymnasium."""
    seeds = rng.bit_generator.seed_seq
    if not isinstance(seeds, np.random.SeedSequence):
        raise TypeError(f"np_random was made from {type(seeds).__name__}; expected SeedSequence")
    return seeds


def check_render_mode(mode: str | None, known: Sequence[str]) -> None:
    """Check a render mode; None means no rendering.

    Raises:
        ValueError: in one line, listing the known modes.
    """
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode={mode!r}; expected {' or '.join(known)}")


def check_options(options: dict[str, Any] | None, known: Sequence[str]) -> dict[str, Any]:
    """Return the options of a reset, empty if None.

    Raises:
        ValueError: in one line, listing the known options, if one is unknown.
    """
    for name in options or {}:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r}; known are {', '.join(known)}")
    return options or {}


def given_x0(source: EpisodeSource, options: dict[str, Any], batch: int) -> np.ndarray | None:
    """Return the initial states (batch, nx) from the reset options, None if not given. Warn if they
    are outside the setup's set.

    Raises:
        ValueError: in one line, if their shape is wrong or they are not finite.
    """
    if "x0" not in options:
        return None
    nx = source.system.nx
    x0 = np.asarray(options["x0"], dtype=float)
    if x0.shape not in ((nx,), (batch, nx)):
        raise ValueError(f"x0 has shape {x0.shape}; expected ({nx},)")
    if not np.isfinite(x0).all():
        raise ValueError(f"x0={x0.tolist()} is not finite")
    if not np.all(source.contains(x0)):
        name = type(source.system).__name__
        gym.logger.warn(f"x0={x0.tolist()} is outside the initial set of {name}")
    return np.broadcast_to(x0, (batch, nx)).copy()
