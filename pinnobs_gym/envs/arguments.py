"""Handling of arguments common to the single and the vectorised environment."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.episodes import Changes, EpisodeSource
from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import check_seed, is_whole, real_array, shortly

NOT_FINITE_REWARD = -1e4
"""Reward of an action that is not finite, which ends the episode."""
_MADE_BY_MAKE = ("system", "num_envs", "changes")
"""Parameters of envs that the id gives, or that are no arguments of their own."""


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


def check_arguments(env: Callable[..., Any], given: Iterable[str]) -> None:
    """Check the names of arguments that an env does not declare itself.

    Args:
        env: class of the env.
        given: names of its further arguments, see `Changes`.

    Raises:
        ValueError: in one line, listing the known arguments.
    """
    declared = [each for each in inspect.signature(env).parameters if each not in _MADE_BY_MAKE]
    known = [*declared, *Changes.__annotations__]
    for name in given:
        if name not in known:
            listed = ", ".join(known)
            raise ValueError(
                f"unknown argument {name!r}; known are {listed}{did_you_mean(name, known)}"
            )


def check_render_mode(mode: str | None, known: Sequence[str]) -> None:
    """Check a render mode; None means no rendering.

    Raises:
        ValueError: in one line, listing the known modes.
    """
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode={mode!r}; expected {' or '.join(known)}")


def seeds_of_rows(seed: Any, num_envs: int) -> list[int | None]:
    """Return the seed of each row of a vectorised env, None for one that is drawn.

    Args:
        seed: that of the first row, which those of the others follow; one for each row, or None for
            rows whose seeds are drawn; or None for all.
        num_envs: number of rows.

    Raises:
        ValueError: in one line, if it is something else.
    """
    if seed is None:
        return [None] * num_envs
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str | bytes):
        first = check_seed(seed)
        return [first + i for i in range(num_envs)]
    if len(seed) != num_envs:
        raise ValueError(f"{len(seed)} seeds; expected {num_envs}, one per row")
    return [None if each is None else check_seed(each) for each in seed]


def masked_rows(mask: Any, num_envs: int) -> np.ndarray:
    """Return the indices of the rows that a mask of several truth values selects.

    Raises:
        ValueError: in one line, if it is no such mask, or selects none.
    """
    try:
        array = np.asarray(mask)
    except ValueError:  # of lists of unequal lengths
        array = np.array(None)
    if array.shape != (num_envs,) or array.dtype != bool:
        given = shortly(mask.tolist() if isinstance(mask, np.ndarray) else mask)
        raise ValueError(f"reset_mask={given}; expected {num_envs} booleans")
    if not array.any():
        raise ValueError(f"reset_mask={array.tolist()} selects no row; expected at least one")
    return np.flatnonzero(array)


def check_num_envs(num_envs: Any) -> int:
    """Return the number of rows of a vectorised env.

    Raises:
        ValueError: in one line, if it is not a whole number of at least 1.
    """
    if isinstance(num_envs, int | np.integer) and num_envs < 1:
        raise ValueError(f"num_envs={shortly(num_envs)}; expected at least 1")
    if not is_whole(num_envs):
        raise ValueError(f"num_envs={shortly(num_envs)}; expected a whole number of at least 1")
    return int(num_envs)


def action_array(action: Any) -> np.ndarray:
    """Return an action, or those of several rows, in double precision.

    Raises:
        ValueError: in one line, if it holds anything else than real numbers.
    """
    if type(action) is np.ndarray and action.dtype.kind == "f":  # the usual case takes no time
        return action.astype(float, copy=False)
    return real_array("action", action, truths=True)


def check_options(options: dict[str, Any] | None, known: Sequence[str]) -> dict[str, Any]:
    """Return the options of a reset, empty if None.

    Raises:
        ValueError: in one line, listing the known options, if one is unknown.
    """
    if options is not None and not isinstance(options, dict):
        raise ValueError(f"options={shortly(options)}; expected a dictionary of reset options")
    for name in options or {}:
        if name not in known:
            raise ValueError(f"unknown reset option {shortly(name)}; known are {', '.join(known)}")
    return options or {}


def given_prior(source: EpisodeSource, options: dict[str, Any], batch: int) -> Prior:
    """Return the prior of the setup, with the mean ``xhat0`` of the reset options if given.

    Raises:
        ValueError: in one line, if their shape is wrong, or they are not finite, beyond the bounds
            of the states, or absurdly large.
    """
    xhat0 = options.get("xhat0")
    prior = Prior.of(source.system, source.setup, batch, xhat0)
    if xhat0 is not None:
        source.check_near("xhat0", np.asarray(xhat0, dtype=float))
    return prior


def given_x0(source: EpisodeSource, options: dict[str, Any], batch: int) -> np.ndarray | None:
    """Return the initial states (batch, nx) from the reset options, None if not given. Warn if they
    are outside the setup's set.

    Raises:
        ValueError: in one line, if their shape is wrong, or they are not finite or absurdly large.
    """
    if options.get("x0") is None:
        return None
    x0 = source.given_states(options["x0"], batch)
    if not np.all(source.contains(x0)):
        name = type(source.system).__name__
        gym.logger.warn(f"x0={x0.tolist()} is outside the initial set of {name}")
    return np.broadcast_to(x0, (batch, source.system.nx)).copy()
