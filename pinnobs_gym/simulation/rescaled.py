"""A plant in other units, with which checks find constants that are hidden in an estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from pinnobs_gym.simulation.bounds import Bounds
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.noise import Level, Noise, SampledLevel
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.residual import Periods
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.start_law import StartLaw
from pinnobs_gym.simulation.system import Array, Setup, System, vector


@dataclass(frozen=True)
class Units:
    """Factors by which numbers change. Powers of two change no rounding."""

    states: float = 1.0
    """Factor of every state."""
    outputs: float = 1.0
    """Factor of every output."""
    time: float = 1.0
    """Factor of the time; 1 for a map, whose time is counted in steps."""

    @property
    def process_noise(self) -> float:
        """Factor of process noise, which is in state units per √s."""
        return self.states / self.time**0.5

    def output_noise(self, level: Level | SampledLevel) -> Level | SampledLevel:
        """Return a level of the output noise in these units."""
        if isinstance(level, SampledLevel):
            return SampledLevel(level.t * self.time, level.std * self.outputs)
        return (np.asarray(level, dtype=float) * self.outputs).tolist()

    def record(self, record: Record) -> Record:
        """Return a record in these units."""
        mean, cov = record.prior.mean * self.states, record.prior.cov * self.states**2
        std = None if record.noise_std is None else record.noise_std * self.outputs
        t, y = record.t * self.time, record.y * self.outputs
        return Record(t, y, record.u, Prior(mean, cov), std)


def rescaled(
    plant: System, units: Units, duration: float | None = None, **attributes: Any
) -> System:
    """Return a plant in other units, of a class of its own with the name of the plant's and the
    setup ``benchmark`` only. Its model takes the same steps as the plant's.

    Args:
        plant: the plant.
        units: the factors of its states, its outputs and the time.
        duration: length (s) of a benchmark episode in place of the plant's, such as a short one,
            for which gains are designed in less time.
        attributes: class attributes that differ from the plant's, such as ``input_hold``.
    """
    s = units.states
    same = ("state_names", "output_names", "input_names", "input_hold", "discrete", "stiff")
    shared = {name: getattr(plant, name) for name in same}
    step, bound = plant.model_step, plant.state_bound
    if not (plant.discrete or plant.own_flow or plant.stiff):
        step = longest_step(plant)
    setup = plant.setups["benchmark"]
    setup = setup if duration is None else replace(setup, duration=duration, transient=None)
    own: dict[str, Any] = {
        "plant": plant,  # of the class: it is made without arguments, as any system
        "units_of": units,
        "scale": _times(vector(plant.scale, plant.nx, "scale"), s),
        "state_bound": None if bound is None else _times(vector(bound, plant.nx, "bound"), s),
        "output_period": _times_each(plant.output_period, units.outputs),
        "state_period": _times_each(plant.state_period, s),
        "state_low": _times_each(plant.state_low, s),
        "state_high": _times_each(plant.state_high, s),
        "model_step": None if step is None else step * units.time,
        "setups": {"benchmark": _setup(plant, setup, units)},
    }
    base = _WithFlow if plant.own_flow else _Rescaled
    cls: Any = type(type(plant).__name__, (base,), {**shared, **own, **attributes})
    return dataclass(frozen=True)(cls)(measured_input=plant.measured_input)


def _times(values: np.ndarray, factor: float) -> tuple[float, ...]:
    return tuple((values * factor).tolist())


def _times_each(values: Bounds | Periods | None, factor: float) -> Any:
    """Return the values times the factor, None where there is none."""
    return None if values is None else tuple(v if v is None else v * factor for v in values)


def _setup(plant: System, setup: Setup, units: Units) -> Setup:
    """Return a setup of a plant in other units."""
    mean, cov = prior_moments(plant, setup)
    transient, step = setup.transient, setup.truth_step
    process = np.asarray(setup.process_noise, dtype=float) * units.process_noise
    return replace(
        setup,
        x0_low=None,
        x0_high=None,
        x0_law=_Law(setup.start(plant.nx), units.states),
        duration=setup.duration * units.time,
        dt=setup.dt * units.time,
        noise_std=units.output_noise(setup.noise_std),
        process_noise=process.tolist(),
        xhat0=_times(mean, units.states),
        P0=tuple(_times(row, units.states**2) for row in cov),
        poor_prior=None,
        transient=None if transient is None else transient * units.time,
        truth_step=None if step is None else step * units.time,
        parameters={},
    )


@dataclass(frozen=True)
class _Law(StartLaw):
    """A law of initial states, in which they are multiplied by a factor."""

    own: StartLaw
    factor: float

    @property
    def mean(self) -> np.ndarray:
        return self.own.mean * self.factor

    @property
    def cov(self) -> np.ndarray:
        return self.own.cov * self.factor**2

    def draw(self, rng: np.random.Generator, count: int) -> np.ndarray:
        return self.own.draw(rng, count) * self.factor

    def contains(self, x: np.ndarray) -> np.ndarray:
        return self.own.contains(x / self.factor)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        return self.own.log_density(x / self.factor)

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray]:
        low, high = self.own.corners
        return low * self.factor, high * self.factor

    @property
    def sentence(self) -> str:
        return f"{self.factor:g} times: {self.own.sentence}"

    @property
    def fixed(self) -> bool:
        return self.own.fixed


@dataclass(frozen=True, eq=False, kw_only=True)
class _RescaledNoise(Noise):
    """The noise of a plant in other units."""

    own: Noise
    units: Units

    def L(self, t: float | np.ndarray) -> np.ndarray:
        own = self.own.L(t / self.units.time)
        return self._derived("L", own, lambda L: L * self.units.process_noise)

    def G(self, t: float) -> np.ndarray:
        own = self.own.G(t / self.units.time)
        return self._derived("G", own, lambda G: G * self.units.outputs)

    def rows(self, rows: np.ndarray | slice) -> _RescaledNoise:
        return replace(super().rows(rows), own=self.own.rows(rows))


@dataclass(frozen=True)
class _Rescaled(System):
    """The base class of plants in other units."""

    plant: ClassVar[System]
    """The plant in its own units."""
    units_of: ClassVar[Units]
    """The factors."""

    def f(self, t: Array, x: Array, u: Array) -> Array:
        s, time = self.units_of.states, self.units_of.time
        return self.plant.f(t / time, x / s, u) * (s / time)

    def h(self, t: Array, x: Array, u: Array) -> Array:
        units = self.units_of
        return self.plant.h(t / units.time, x / units.states, u) * units.outputs

    def f_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        time = self.units_of.time
        return self.plant.f_jacobian(t / time, x / self.units_of.states, u) / time

    def h_jacobian(self, t: Array, x: Array, u: Array) -> Array:
        units = self.units_of
        own = self.plant.h_jacobian(t / units.time, x / units.states, u)
        return own * (units.outputs / units.states)

    def input(self, t: Array) -> Array:
        return self.plant.input(t / self.units_of.time)

    def admissible(self, x0: Array) -> Array:
        return self.plant.admissible(x0 / self.units_of.states)

    def observable(self, x: Array) -> Array:
        return self.plant.observable(x / self.units_of.states)

    def distances(self) -> tuple[np.ndarray, np.ndarray] | None:
        return self.plant.distances()

    def breakpoints(self) -> tuple[float, ...]:
        return tuple(t * self.units_of.time for t in self.plant.breakpoints())

    def noise(
        self, noise_std: Level | SampledLevel | None = None, process_noise: Level | None = None
    ) -> Noise:
        units, setup = self.units_of, self.setups["benchmark"]
        to_own = Units(1 / units.states, 1 / units.outputs, 1 / units.time)
        level = setup.noise_std if noise_std is None else noise_std
        process = setup.process_noise if process_noise is None else process_noise
        given = (np.asarray(process, dtype=float) * to_own.process_noise).tolist()
        own = self.plant.noise(to_own.output_noise(level), given)
        return _RescaledNoise(own.process, own.output, own.samples, own=own, units=units)


@dataclass(frozen=True)
class _WithFlow(_Rescaled):
    """The same for a plant with a flow of its own."""

    def flow(self, t0: Array, t1: Array, x: Array, u: Array) -> Array:
        s, time = self.units_of.states, self.units_of.time
        return self.plant.flow(t0 / time, t1 / time, x / s, u) * s

    def flow_jacobian(self, t0: Array, t1: Array, x: Array, u: Array) -> Array:
        time = self.units_of.time
        return self.plant.flow_jacobian(t0 / time, t1 / time, x / self.units_of.states, u)
