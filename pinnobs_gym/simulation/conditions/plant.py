"""Conditions of the plant: it differs from the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np

from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.conditions.base import Condition, Unknowns
from pinnobs_gym.simulation.residual import Periods
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import Array, Setup, System, vector


def uncertain_parameters(system: System) -> tuple[str, ...]:
    """Return the names of the parameters that `Mismatch` changes: those of `System.uncertain`, or
    all that are numbers but switches. If there are none, it changes the rates of change instead."""
    if system.uncertain is not None:
        return tuple(system.uncertain)
    return tuple(name for name, value in system.parameters.items() if _is_number(value))


def _is_number(value: object) -> bool:
    """Return whether a parameter is a number or an array of numbers. Nested tuples of different
    lengths, which are no array, are none."""
    try:
        return np.asarray(value).dtype.kind in "iuf"
    except ValueError:
        return False


@dataclass(frozen=True)
class Mismatch(Condition):
    """A plant whose parameters each differ from the model's by the same fraction, with a random
    sign per parameter and episode.

    `System.uncertain` selects the parameters. If there are none, the rates of change are changed
    instead: ẋᵢ = (1 ± fraction)·fᵢ or, of a map, xᵢ⁺ − xᵢ = (1 ± fraction)·(fᵢ − xᵢ).
    """

    part: float
    reference = False

    @property
    def summary(self) -> str:
        return f"parameters of the plant off by ±{100 * self.part:g} %, the model's nominal"

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        off = self._off(system)
        count = len(off.std)
        signs = np.array([2.0 * rng.integers(0, 2, count) - 1 for rng in rngs]).reshape(-1, count)
        return off.plant(system, self.part * signs)

    def plants(self, system: System) -> tuple[System, ...]:
        off = self._off(system)
        signs = product((-1.0, 1.0), repeat=len(off.std))
        return tuple(off.plant(system, self.part * np.array([each])) for each in signs)

    def unknowns(self, system: System, setup: Setup) -> tuple[Unknowns, ...]:
        """The relative deviation of each parameter, or of each rate of change."""
        return (self._off(system),)

    def _off(self, system: System) -> _RelativeDeviations:
        names = uncertain_parameters(system)
        return _RelativeDeviations((self.part,) * (len(names) or system.nx), names)


@dataclass(frozen=True)
class _RelativeDeviations(Unknowns):
    """Relative deviations of parameters or, if none is named, of the rates of change."""

    names: tuple[str, ...]

    def plant(self, system: System, deviations: np.ndarray) -> System:
        factors = 1 + deviations
        if not self.names:
            return OtherRates(system, factors)
        changed = {n: getattr(system, n) * f for n, f in zip(self.names, factors.T, strict=True)}
        return replace(system, **changed)


@dataclass(frozen=True)
class OtherRates(System):
    """A plant with the rate of change of each state multiplied by a factor, or that of a map its
    change in a step."""

    plant: System
    """The original plant."""
    factors: np.ndarray
    """Factor of each rate of change, shape (batch, nx)."""

    @property
    def state_names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the original plant's states."""
        return self.plant.state_names

    @property
    def scale(self) -> tuple[float, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Scale of the original plant's states."""
        return self.plant.scale

    @property
    def output_period(self) -> Periods | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Periods of the original plant's outputs."""
        return self.plant.output_period

    @property
    def state_period(self) -> Periods | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Periods of the original plant's states."""
        return self.plant.state_period

    @property
    def state_box(self) -> StateBox | None:
        """Bounds of the original plant's states."""
        return self.plant.state_box

    @property
    def model_step(self) -> float:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Longest Runge-Kutta step of the original plant in s."""
        return longest_step(self.plant)

    @property
    def discrete(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the original plant is a map."""
        return self.plant.discrete

    @property
    def stiff(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Whether the original plant is stiff."""
        return self.plant.stiff

    def f(self, t: Array, x: Array, u: Array) -> Array:
        rate = self.plant.f(t, x, u)
        return x + self.factors * (rate - x) if self.discrete else self.factors * rate

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        A = self.plant.f_jacobian(t, x, u)
        if not self.discrete:
            return self.factors[..., None] * A
        unit = np.eye(x.shape[-1])
        return unit + self.factors[..., None] * (A - unit)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        return self.plant.h(t, x, u)

    def input(self, t: Array) -> Array:
        return self.plant.input(t)

    def breakpoints(self) -> tuple[float, ...]:
        return self.plant.breakpoints()


@dataclass(frozen=True)
class LoadStep(Condition):
    """A step of a motor's load torque at 0.6 s to a value uniform in 0 to 40 N·m."""

    time: float = 0.6
    highest: float = 40.0
    reference = False

    @property
    def summary(self) -> str:
        return f"the motor's load torque steps at {self.time:g} s to 0 to {self.highest:g} N·m"

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        if not {"T_L", "load_step_torque"} <= {f.name for f in fields(system)}:
            raise ValueError(
                f"condition 'load_step' needs a plant with a load torque; "
                f"{type(system).__name__} has none"
            )
        torque = np.array([rng.uniform(0.0, self.highest) for rng in rngs])
        changes = {"load_step_time": self.time, "load_step_torque": torque}
        return replace(system, **changes)

    def plants(self, system: System) -> tuple[System, ...]:
        raise ValueError("condition 'load_step' draws a torque from an interval; it has no list")

    def unknowns(self, system: System, setup: Setup) -> tuple[Unknowns, ...]:
        """The torque after the step, relative to the model's torque T_L, which has none."""
        torque: float = getattr(system, "T_L")  # noqa: B009 (not a parameter of every system)
        spread, offset = self.highest / np.sqrt(12), self.highest / 2 - torque
        return (_OtherTorque((float(np.hypot(spread, offset)),), self.time, torque),)


@dataclass(frozen=True)
class _OtherTorque(Unknowns):
    """The deviation of a motor's load torque (N·m) from that of the model, from a time on."""

    time: float
    """Time of the step (s)."""
    torque: float
    """The model's torque (N·m)."""

    def plant(self, system: System, deviations: np.ndarray) -> System:
        changes = {
            "load_step_time": self.time,
            "load_step_torque": self.torque + deviations[:, 0],
        }
        return replace(system, **changes)


@dataclass(frozen=True)
class ProcessNoise(Condition):
    """Process noise, with a standard deviation after the time between two samples that is the same
    fraction of each state's scale."""

    part: float

    @property
    def summary(self) -> str:
        return f"process noise of {self.part:g} of the scale per sample"

    def process_noise(self, system: System, setup: Setup) -> np.ndarray:
        return np.diag(self.part / np.sqrt(setup.dt) * vector(system.scale, system.nx, "scale"))
