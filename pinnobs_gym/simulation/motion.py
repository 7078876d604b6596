"""How a model moves other than by Runge-Kutta steps, and what its inputs are between samples."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.simulation.arrays import array_namespace
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.system import Array, System

MOST_STEPS = 100_000
"""Largest number of steps of the model or the truth between two samples."""


def check_steps(system: System, t0: Array, t1: Array, count: float, longest: float) -> None:
    """Check that a plant need not take more than `MOST_STEPS` from one sample to the next, which
    would not end.

    Args:
        system: the plant.
        t0: time of the first sample in s, or one for each row (batch,).
        t1: time of the second.
        count: number of steps.
        longest: the longest step in s.

    Raises:
        ValueError: in one line with the times, the number of steps and what was expected.
    """
    if count <= MOST_STEPS:
        return
    start, end = np.broadcast_arrays(np.asarray(t0, dtype=float), np.asarray(t1, dtype=float))
    row = int(np.argmax(end - start))
    unit, of = ("", "") if system.discrete else (" s", f" of at most {longest:g} s")
    raise ValueError(
        f"from t={start.flat[row]:.15g}{unit} to t={end.flat[row]:.15g}{unit}, "
        f"{type(system).__name__} would take {count:.3g} steps{of}; expected at most {MOST_STEPS} "
        "between two samples, with all times of one clock and in the unit of the model"
    )


@dataclass(frozen=True, eq=False)
class Interval:
    """A time interval between two samples, and the inputs in it."""

    system: System
    t0: Array
    """Time of the first sample in s, a number or one for each row (batch,)."""
    t1: Array
    """Time of the second sample in s, like ``t0``."""
    u0: Array | None
    """Inputs at the first, shape (..., nu); used only if the system's input is measured."""
    u1: Array | None
    """Inputs at the second."""

    def input(self, t: Array) -> Array:
        """Return the inputs (..., nu) at times t (...) of the interval: those that the system
        defines or, if they are measured, as `System.input_hold` says.

        Raises:
            ValueError: in one line, if they are measured and missing.
        """
        if not self.system.measured_input:
            return self.system.input(t)
        if self.system.input_hold == "previous":
            return required(self.system, self.u0)
        u0, u1 = required(self.system, self.u0), required(self.system, self.u1)
        part = ((t - self.t0) / (self.t1 - self.t0))[..., None]
        return (1 - part) * u0 + part * u1


def required(system: System, u: Array | None) -> Array:
    """Return measured inputs.

    Raises:
        ValueError: in one line, if there are none.
    """
    if u is None:
        raise ValueError(f"{type(system).__name__} has a measured input; u is missing")
    return u


def inputs_at(system: System, t: Array, part: Array, u0: Array | None, u1: Array | None) -> Array:
    """Return the inputs (n, ..., nu) at n times t, (n,) or (n, batch), of an interval between two
    samples.

    Args:
        system: the model.
        t: the times in s.
        part: their positions in the interval, from 0 to 1, shape (n,) or (n, batch).
        u0: inputs at the first sample, shape (..., nu); see `Interval`.
        u1: inputs at the second.
    """
    if not system.measured_input:
        return system.input(t)
    before = required(system, u0)
    if system.input_hold == "previous":
        xp: Any = array_namespace(before)
        return xp.broadcast_to(before, (len(part), *before.shape))
    weight = part[..., None] if part.ndim == 2 else part.reshape(len(part), *([1] * before.ndim))
    return (1 - weight) * before + weight * required(system, u1)


class Motion(ABC):
    """A way to propagate states from one sample to the next. The rows of a batch are independent
    of each other."""

    @abstractmethod
    def step(self, over: Interval, x: np.ndarray) -> np.ndarray:
        """Return the states (..., nx) at the end of the interval, from x (..., nx) at its start."""

    @abstractmethod
    def moments(
        self, over: Interval, noise: Noise | None, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the states at the end from x (batch, nx), their Jacobian F (nx, nx, batch), and
        the covariance Q (nx, nx, batch or 1) of the process noise, zero if ``noise`` is None."""

    @abstractmethod
    def noisy(
        self,
        over: Interval,
        noise: Noise,
        x: np.ndarray,
        normal: Callable[[int], np.ndarray],
    ) -> np.ndarray:
        """Return the states at the end from x (num_points, batch, nx), with process noise from
        standard normal numbers ``normal(m)`` (num_points, 1 or batch, m)."""
