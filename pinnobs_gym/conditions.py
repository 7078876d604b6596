"""Conditions: ways in which an episode departs from what its setup says."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np

from pinnobs_gym.system import Array, Setup, System, vector


def noise_scale(system: System, setup: Setup) -> np.ndarray:
    """The output noise (ny,) that conditions multiply: the setup's, or where that is zero the
    benchmark's."""
    own = vector(setup.noise_std, system.ny, "noise_std")
    benchmark = vector(system.setups["benchmark"].noise_std, system.ny, "noise_std")
    return np.where(own > 0, own, benchmark)


@dataclass(frozen=True)
class Outputs:
    """Noisy outputs of some episodes."""

    t: np.ndarray
    """Sample times in s, shape (num_samples,)."""
    y: np.ndarray
    """Shape (num_samples, batch, ny)."""
    noise_std: np.ndarray
    """What `noise_scale` gives, shape (ny,)."""


@dataclass(frozen=True)
class Condition:
    """What changes in an episode. The base class changes nothing.

    Each method gets one random generator per episode and must draw from it in the same way however
    many episodes there are, so that an episode does not depend on those simulated with it.
    """

    told: ClassVar[str] = "nothing"
    """What estimators are told of it."""
    reference: ClassVar[bool] = True
    """Whether the Cramér-Rao reference of the model, the prior and the noise that estimators are
    told, and of the process noise, is that of these episodes."""

    @property
    def summary(self) -> str:
        """What it changes, in a few words."""
        return "nothing: the setup as it is"

    def setup(self, system: System, setup: Setup) -> Setup:
        """The setup that is played; estimators are told of it."""
        return setup

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """What becomes of initial states (n, nx) of the setup's set, or of as many of them as may
        be used; ``inside`` says which states (..., nx) belong to the set: bool (...)."""
        return x0

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        """The true plant, its parameters numbers or arrays (batch,); estimators keep the model."""
        return system

    def process_noise(self, system: System) -> np.ndarray | None:
        """Standard deviations (nx,) of white noise added to the state at every sample after the
        first, in state units; None for none."""
        return None

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        """What becomes of noisy outputs on the way: a new array of y's shape, in which NaN is a
        missing output."""
        return sent.y


@dataclass(frozen=True)
class Noise(Condition):
    """Output noise of another strength, times that of `noise_scale`."""

    factor: float
    told = "its strength"

    @property
    def reference(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Not without noise, where it is zero."""
        return self.factor > 0

    @property
    def summary(self) -> str:
        return f"output noise × {self.factor:g}"

    def setup(self, system: System, setup: Setup) -> Setup:
        std = self.factor * noise_scale(system, setup)
        return replace(setup, noise_std=tuple(std.tolist()))


@dataclass(frozen=True)
class SampleTime(Condition):
    """Another time between samples, in episodes as long as before."""

    factor: float
    told = "the sample times"

    @property
    def summary(self) -> str:
        return f"time between samples × {self.factor:g}"

    def setup(self, system: System, setup: Setup) -> Setup:
        return replace(setup, dt=self.factor * setup.dt)


@dataclass(frozen=True)
class FarGuess(Condition):
    """An initial estimate that is further away: each of its components moved by one standard
    deviation of the prior away from the middle of the initial set. P₀ stays."""

    reference = False
    told = "x̂₀"

    @property
    def summary(self) -> str:
        return "x̂₀ moved by √P₀ away from the middle of the initial set"

    def setup(self, system: System, setup: Setup) -> Setup:
        low, high, xhat0, P0_std = (
            vector(getattr(setup, name), system.nx, name)
            for name in ("x0_low", "x0_high", "xhat0", "P0_std")
        )
        away = np.where(xhat0 >= (low + high) / 2, 1.0, -1.0)
        return replace(setup, xhat0=tuple((xhat0 + away * P0_std).tolist()))


@dataclass(frozen=True)
class OutsideSet(Condition):
    """Initial states outside the setup's set: states of the set times a factor, where that leads
    out of it."""

    factor: float = 1.5
    reference = False

    @property
    def summary(self) -> str:
        return f"x₀ outside the initial set: {self.factor:g} times a state of it"

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        x0 = self.factor * x0
        return x0[~inside(x0)]


@dataclass(frozen=True)
class Mismatch(Condition):
    """A plant that is not the model: each of its parameters off by the same part, its sign drawn
    per parameter and episode.

    Which parameters, `System.uncertain` says. Of a plant without any the rates of change are off:
    ẋᵢ = (1 ± part)·fᵢ.
    """

    part: float
    reference = False

    @property
    def summary(self) -> str:
        return f"parameters of the plant off by ±{100 * self.part:g} %, the model's nominal"

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        parameters = system.parameters
        names = system.uncertain
        if names is None:
            names = [n for n, v in parameters.items() if not isinstance(v, bool | np.bool_)]
        count = len(names) or system.nx
        signs = np.array([2.0 * rng.integers(0, 2, count) - 1 for rng in rngs]).reshape(-1, count)
        factors = 1 + self.part * signs
        if not names:
            return OtherRates(system, factors)
        changed = {n: parameters[n] * f for n, f in zip(names, factors.T, strict=True)}
        return replace(system, **changed)


@dataclass(frozen=True)
class OtherRates(System):
    """A plant that moves as another one does, each state at a rate of its own."""

    plant: System
    """The other."""
    factors: np.ndarray
    """What its rates of change are multiplied with, shape (batch, nx)."""

    @property
    def state_names(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As the other's."""
        return self.plant.state_names

    @property
    def scale(self) -> tuple[float, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """As the other's."""
        return self.plant.scale

    def f(self, t: Array, x: Array, u: Array) -> Array:
        return self.factors * self.plant.f(t, x, u)

    def h(self, x: Array) -> Array:
        return self.plant.h(x)

    def input(self, t: Array) -> Array:
        return self.plant.input(t)

    def breakpoints(self) -> tuple[float, ...]:
        return self.plant.breakpoints()


@dataclass(frozen=True)
class LoadStep(Condition):
    """The load torque of a motor steps at 0.6 s to a value uniform in 0 to 40 N·m."""

    time: float = 0.6
    highest: float = 40.0
    reference = False

    @property
    def summary(self) -> str:
        return f"the motor's load torque steps at {self.time:g} s to 0 to {self.highest:g} N·m"

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        if "load_step_torque" not in {f.name for f in fields(system)}:
            raise ValueError(
                f"condition 'load_step' needs a plant with a load torque; "
                f"{type(system).__name__} has none"
            )
        torque = np.array([rng.uniform(0.0, self.highest) for rng in rngs])
        changes = {"load_step_time": self.time, "load_step_torque": torque}
        return replace(system, **changes)


@dataclass(frozen=True)
class ProcessNoise(Condition):
    """White Gaussian noise added to the state at every sample after the first, of the same part of
    each state's scale."""

    part: float

    @property
    def summary(self) -> str:
        return f"process noise of {self.part:g} of the scale per sample"

    def process_noise(self, system: System) -> np.ndarray:
        return self.part * vector(system.scale, system.nx, "scale")


@dataclass(frozen=True)
class Outliers(Condition):
    """Some samples off by a Gaussian error many times the noise of `noise_scale`."""

    probability: float
    strength: float
    reference = False

    @property
    def summary(self) -> str:
        return f"{100 * self.probability:g} % of the outputs off by {self.strength:g} σ"

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        shape = (len(sent.y), sent.y.shape[-1])
        errors = [
            (rng.random(shape) < self.probability) * rng.standard_normal(shape) for rng in rngs
        ]
        return sent.y + np.stack(errors, axis=1) * (self.strength * sent.noise_std)


@dataclass(frozen=True)
class Delay(Condition):
    """Outputs that arrive some samples late: at sample k stands y of k − d, and nothing in the
    first d. Nothing else is late."""

    samples: int
    reference = False

    @property
    def summary(self) -> str:
        return f"outputs {self.samples} sample{'s' * (self.samples > 1)} late"

    def setup(self, system: System, setup: Setup) -> Setup:
        if setup.num_steps <= self.samples:
            raise ValueError(
                f"condition 'delay{self.samples}' leaves no output in {setup.num_steps} sample(s)"
            )
        return setup

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        late = np.full_like(sent.y, np.nan)
        late[self.samples :] = sent.y[: -self.samples]
        return late


@dataclass(frozen=True)
class Dropouts(Condition):
    """Samples missing at random, each with the same probability."""

    probability: float
    told = "which are missing"

    @property
    def summary(self) -> str:
        return f"{100 * self.probability:g} % of the outputs missing"

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        shape = (len(sent.y), sent.y.shape[-1])
        lost = [rng.random(shape) < self.probability for rng in rngs]
        return np.where(np.stack(lost, axis=1), np.nan, sent.y)


@dataclass(frozen=True)
class Gap(Condition):
    """A time without outputs, anywhere in the episode: 1 s, or a fifth of episodes that are shorter
    than 5 s."""

    seconds: float = 1.0
    largest_part: float = 0.2
    told = "which are missing"

    @property
    def summary(self) -> str:
        return (
            f"no output for {self.seconds:g} s, at most {100 * self.largest_part:g} % of the time"
        )

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        t = sent.t
        length = min(self.seconds, self.largest_part * float(t[-1] - t[0]))
        first = np.array([rng.uniform(t[0], t[-1] - length) for rng in rngs])
        lost = (t[:, None] >= first) & (t[:, None] < first + length)
        return np.where(lost[..., None], np.nan, sent.y)


@dataclass(frozen=True)
class Combined(Condition):
    """Several conditions at once, applied in order."""

    parts: tuple[Condition, ...]

    @property
    def told(self) -> str:  # pyright: ignore[reportIncompatibleVariableOverride]
        """What is told of the parts."""
        return ", ".join(dict.fromkeys(part.told for part in self.parts if part.told != "nothing"))

    @property
    def reference(self) -> bool:  # pyright: ignore[reportIncompatibleVariableOverride]
        """If it is with all parts."""
        return all(part.reference for part in self.parts)

    @property
    def summary(self) -> str:
        return "; ".join(part.summary for part in self.parts)

    def setup(self, system: System, setup: Setup) -> Setup:
        for part in self.parts:
            setup = part.setup(system, setup)
        return setup

    def starts(self, x0: np.ndarray, inside: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        for part in self.parts:
            x0 = part.starts(x0, inside)
        return x0

    def plant(self, system: System, rngs: Sequence[np.random.Generator]) -> System:
        for part in self.parts:
            system = part.plant(system, rngs)
        return system

    def process_noise(self, system: System) -> np.ndarray | None:
        stds = [part.process_noise(system) for part in self.parts]
        return next((std for std in stds if std is not None), None)

    def outputs(self, sent: Outputs, rngs: Sequence[np.random.Generator]) -> np.ndarray:
        for part in self.parts:
            sent = replace(sent, y=part.outputs(sent, rngs))
        return sent.y


CONDITIONS: dict[str, Condition] = {
    "nominal": Condition(),
    **{f"noise{factor:g}": Noise(factor) for factor in (0, 0.1, 0.5, 5, 15)},
    **{f"dt{factor:g}": SampleTime(factor) for factor in (0.5, 2, 5)},
    "xhat0_far": FarGuess(),
    "x0_outside": OutsideSet(),
    **{f"mismatch{percent}": Mismatch(percent / 100) for percent in (10, 30)},
    "load_step": LoadStep(),
    "process_noise1e-3": ProcessNoise(1e-3),
    "process_noise1e-2": ProcessNoise(1e-2),
    "outliers": Outliers(probability=0.05, strength=50.0),
    **{f"delay{samples}": Delay(samples) for samples in (1, 2, 3, 4, 5)},
    **{f"dropout{percent}": Dropouts(percent / 100) for percent in (10, 30, 50)},
    "gap": Gap(),
}
"""The conditions by name, in the order in which they act; ``a+b`` is both."""


def canonical_name(name: str) -> str:
    """The one name of a condition: its parts in the order in which they act, whichever order they
    are named in, and ``nominal`` only alone.

    Raises:
        ValueError: listing the known ones, if one is unknown; naming two of one kind.
    """
    named = name.split("+")
    for part in named:
        if part not in CONDITIONS:
            raise ValueError(f"unknown condition {part!r}; known are {', '.join(CONDITIONS)}")
    named.sort(key=list(CONDITIONS).index)
    for first, second in pairwise(named):
        if type(CONDITIONS[first]) is type(CONDITIONS[second]):
            raise ValueError(
                f"condition {name!r}: {first!r} and {second!r} change the same; name one"
            )
    return "+".join(part for part in named if part != "nominal") or "nominal"


def parse_condition(name: str) -> Condition:
    """The condition of that name, or several joined by ``+``, in whichever order they are named.

    Raises:
        ValueError: as `canonical_name` does.
    """
    parts = tuple(CONDITIONS[part] for part in canonical_name(name).split("+"))
    return parts[0] if len(parts) == 1 else Combined(parts)


def fitting(system: System, setup: Setup) -> list[str]:
    """The names of all conditions that a system can be played under in a setup."""
    names = []
    for name, condition in CONDITIONS.items():
        try:
            condition.setup(system, setup)
            condition.plant(system, ())
        except ValueError:
            continue
        names.append(name)
    return names
