"""The Runge-Kutta method of model-based estimators, and the step that keeps it precise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np

from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.system import Array, System, initial_states, vector
from pinnobs_gym.simulation.truth import truth

STEP_TOLERANCE = 1e-6
"""Largest local error of a step of `longest_step`, relative to the larger of a state and its
scale."""

_HALVINGS = 12
"""Largest number of halvings of the benchmark's dt."""
_GAIN = 4
"""Factor by which a halving has to reduce the local error, of a possible 32 where f is smooth."""
_STATES = 16
"""Number of initial states from which steps are tried."""
_PATHS = 4
"""Number of them whose trajectories are followed, for steps from further states."""
_TIMES = 40
"""Number of times of each trajectory, evenly spread over an episode."""


def runge_kutta(rate: Callable[[int, Array], Array], x: Array, h: Array | float) -> Array:
    """Take one step of the classical Runge-Kutta method of order 4 (Kutta 1901).

    Args:
        rate: dx/dt as a function of the stage, 0 to 3, and the point of that stage. The stages are
            at the start, twice at the middle, and at the end of the step.
        x: the point at the start of the step.
        h: length of the step.

    Returns:
        The point at the end of the step.
    """
    k1 = rate(0, x)
    point = h / 2 * k1
    point += x
    k2 = rate(1, point)
    point = h / 2 * k2
    point += x
    k3 = rate(2, point)
    point = h * k3
    point += x
    k4 = rate(3, point)
    # x + h(k1 + 2k2 + 2k3 + k4)/6, accumulated in place
    end = k2 + k3
    end *= 2
    end += k1
    end += k4
    end *= h / 6
    end += x
    return end


def longest_step(system: System) -> float:
    """Return the longest Runge-Kutta step (s) of model-based estimators: the system's
    `System.model_step` or, if it has none, the benchmark's dt divided by the smallest power of two
    that keeps the local error within `STEP_TOLERANCE`.

    The local error is that of steps from 16 states of the benchmark's initial set, and from 40
    times of the trajectories of four of them: the difference from two half steps, by Richardson's
    extrapolation (Hairer, Nørsett & Wanner, "Solving Ordinary Differential Equations I", II.4).
    Where f is not smooth, such as with friction, no step is that precise; halving ends when it no
    longer reduces the error fourfold. Parameters that are arrays, one number per row of a batch,
    count with the benchmark's value. The result is kept.

    A map has steps of 1. The steps of a stiff plant are controlled, and have no such limit.
    """
    if system.discrete:
        return 1.0
    if system.stiff and system.model_step is None:
        return np.inf
    if system.model_step is not None:
        return system.model_step
    kept = vars(system)  # the attributes of this instance, which is frozen to others
    if _KEPT not in kept:
        kept[_KEPT] = _found_step(_one_plant(system))
    return kept[_KEPT]


_KEPT = "_longest_step"
"""Key of the step among the attributes of an instance."""


def _one_plant(system: System) -> System:
    """Return the system with the benchmark's values of parameters that are one per row."""
    own, _ = type(system).configured()
    values = {f.name: (getattr(system, f.name), getattr(own, f.name)) for f in fields(system)}
    by_row = {name: b for name, (a, b) in values.items() if np.ndim(a) > np.ndim(b)}
    return replace(system, measured_input=False, **by_row)


@cached_by_plant
def _found_step(system: System) -> float:
    """Return `longest_step` of a system without `System.model_step`."""
    dt = system.setups["benchmark"].dt
    t, x = _samples(system)
    before = np.inf
    for halvings in range(_HALVINGS + 1):
        error = _local_error(system, t, x, dt / 2**halvings)
        if error <= STEP_TOLERANCE:
            return dt / 2**halvings
        if error < 1 and not error < before / _GAIN:
            return dt / 2 ** (halvings - 1)
        before = error
    return dt / 2**_HALVINGS if np.isfinite(before) else dt


def _samples(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return times (n,) and states (n, nx) at which the plant may be during an episode."""
    setup = system.setups["benchmark"]
    x0 = initial_states(system, setup, _STATES)
    times = np.linspace(0.0, setup.duration, _TIMES + 1)[:-1]
    try:
        paths = truth(system, x0[:_PATHS], times, setup.truth_step)
    except FloatingPointError:  # the plant cannot be simulated that far, but may be estimated
        return np.zeros(_STATES), x0
    t = np.concatenate([np.zeros(_STATES), np.repeat(times, _PATHS)])
    return t, np.concatenate([x0, paths.reshape(-1, system.nx)])


def _local_error(system: System, t: np.ndarray, x: np.ndarray, step: float) -> float:
    """Return the largest local error of a step (s) from these times (n,) and states (n, nx).

    Steps over a breakpoint of the system do not count, nor do states where f is not finite.
    """

    def stepped(x: np.ndarray, start: np.ndarray, h: float) -> np.ndarray:
        parts = np.array([0.0, 0.5, 0.5, 1.0])[:, None] * h
        times = start + parts
        inputs = np.asarray(system.input(times))
        return runge_kutta(lambda k, x: system.f(times[k], x, inputs[k]), x, h)

    with np.errstate(all="ignore"):
        counted = np.isfinite(system.f(t, x, np.asarray(system.input(t)))).all(axis=-1)
        for b in system.breakpoints():
            counted &= (b < t) | (b > t + step)
        t, x = t[counted], x[counted]
        whole = stepped(x, t, step)
        halves = stepped(stepped(x, t, step / 2), t + step / 2, step / 2)
        size = np.maximum(abs(halves), vector(system.scale, system.nx, "scale"))
        # A step of order 4 has 16/15 of the error by which two half steps differ from it.
        errors = abs(whole - halves) / size * 16 / 15
    return float(np.nan_to_num(errors, nan=np.inf).max(initial=0.0))
