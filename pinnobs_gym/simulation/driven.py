"""A plant between two samples, with inputs that are given at these."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from pinnobs_gym.simulation.system import Array, System


def driven(plant: System, times: np.ndarray, inputs: np.ndarray) -> System:
    """Return a plant whose inputs between two samples follow from those at the samples, as
    `System.input_hold` says.

    Args:
        plant: the plant.
        times: the times of the two samples in s, shape (2,).
        inputs: inputs at them, shape (2, batch, nu).
    """
    start, end = (float(t) for t in times)
    return _class_of(type(plant))(plant, start, end, inputs[0], inputs[1])


@cache
def _class_of(cls: type[System]) -> Any:
    """Return the class of a driven plant, which has the attributes and the name of the plant's."""
    names = (
        "state_names",
        "output_names",
        "input_names",
        "scale",
        "input_hold",
        "stiff",
        "model_step",
    )
    shared = {name: property(lambda self, name=name: getattr(self.plant, name)) for name in names}
    return dataclass(frozen=True)(type(cls.__name__, (Driven,), shared))


@dataclass(frozen=True)
class Driven(System):
    """A plant with inputs that are given at two samples."""

    plant: System
    """The plant."""
    start: float
    """Time of the first sample in s."""
    end: float
    """Time of the second sample in s."""
    first: np.ndarray
    """Inputs at the first, shape (batch, nu)."""
    second: np.ndarray
    """Inputs at the second, shape (batch, nu)."""

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.f(t, x, u)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.h(t, x, u)

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.f_jacobian(t, x, u)

    def input(self, t: Array) -> Array:
        """Return the inputs (..., batch, nu) at times t, (...) or (..., 1)."""
        t = np.asarray(t)
        part = (t[..., 0] if t.ndim and t.shape[-1] == 1 else t) - self.start
        weight = part[..., None, None] / (self.end - self.start)
        if self.input_hold == "previous":
            weight = np.zeros_like(weight)
        return (1 - weight) * self.first + weight * self.second

    def breakpoints(self) -> tuple[float, ...]:
        return self.plant.breakpoints()
