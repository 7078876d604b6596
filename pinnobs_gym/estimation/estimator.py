"""The interface that every estimator has, and how one is run over records."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np

from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import NOISE_FLOOR, Setup, System, output_scale, vector


@dataclass(frozen=True)
class State:
    """The running state of an estimator, for a batch of episodes. A row that has diverged carries
    values that are not finite."""

    xhat: np.ndarray
    """Estimates x̂(k|k), shape (batch, nx)."""
    t: float | None = None
    """Time of the last sample in s; None before the first."""
    u: np.ndarray | None = None
    """Inputs at the last sample, shape (batch, nu); None before the first."""
    P: np.ndarray | None = None
    """Covariances of the estimates, shape (batch, nx, nx), where the estimator has them."""
    innovation: np.ndarray | None = None
    """y − h(t, x̂(k|k−1), u), shape (batch, ny), zero where y was missing."""
    S: np.ndarray | None = None
    """Covariances of the innovations, shape (batch, ny, ny)."""
    memory: Any = None
    """Whatever else the estimator must remember."""


@dataclass(frozen=True)
class Estimates:
    """What an estimator makes of a batch of records: x̂(k|k) at every sample, and the covariances
    and innovations where it has them."""

    xhat: np.ndarray
    """Shape (batch, num_samples, nx)."""
    P: np.ndarray | None = None
    """Shape (batch, num_samples, nx, nx)."""
    innovation: np.ndarray | None = None
    """Shape (batch, num_samples, ny)."""
    S: np.ndarray | None = None
    """Shape (batch, num_samples, ny, ny)."""


@dataclass(frozen=True)
class Range:
    """Where a setting is searched; whole numbers only if both bounds are."""

    low: float
    high: float
    log: bool = False
    """Whether by its logarithm."""

    @property
    def whole(self) -> bool:
        """Whether it takes whole numbers only."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class BaseEstimator(ABC):
    """What estimators have in common, `Estimator` the online and `OfflineEstimator` the offline
    ones.

    They are immutable. An estimator sees outputs, inputs and the model alone: the model may differ
    from the true plant, and the state, the reward and an env's ``info`` are not shown to it.
    """

    system: System
    """The model of the plant."""
    noise_std: Sequence[float] | float | None = None
    """The standard deviation of the output noise that the estimator is told, in output units; the
    benchmark's if None."""

    track: ClassVar[str]
    """``online`` (causal) or ``offline`` (sees the whole record first); ranked apart."""
    trains_on_record: ClassVar[str | None] = None
    """The name of the trainer that it runs on every record it is given, if it does."""
    knows: ClassVar[tuple[str, ...]] = ("model", "prior", "noise")
    """What it is told besides the outputs and inputs."""
    needs_training: ClassVar[str | None] = None
    """Name of the trainer that must make it, if `for_setup` alone cannot."""
    tunable: ClassVar[Mapping[str, Range]] = {}
    """Which of its settings are searched by ``pinnobs tune``, and where."""
    recipe: ClassVar[Mapping[str, Any]] = {}
    """Choices in that trainer's Config that are made for it unless others are."""
    exempt_from: ClassVar[Mapping[str, str]] = {}
    """Checks of `pinnobs_gym.estimation.checks.check_estimator` that it is not held to, by name,
    and why not, in a line each."""
    equations: ClassVar[str] = ""
    """Its equations in LaTeX for its page, one below the other as in an ``aligned`` environment;
    φ is the model's flow from the sample before, and a raised minus marks what precedes y_k."""

    @classmethod
    def for_setup(cls, system: System, setup: Setup, **options: Any) -> Self:
        """The estimator with default tuning for a model and what a setup says of the noise."""
        return cls(system, noise_std=setup.noise_std, **options)

    @abstractmethod
    def run(self, record: Record) -> Estimates:
        """The estimates over whole records."""

    @property
    def output_variance(self) -> np.ndarray:
        """Diagonal of R, shape (ny,), in squared output units.

        Without noise it is not zero, which no filter takes, but (1e-3 of the output's scale)²; see
        `output_scale`.
        """
        benchmark = self.system.setups["benchmark"].noise_std
        known_noise = benchmark if self.noise_std is None else self.noise_std
        std = vector(known_noise, self.system.ny, "noise_std")
        if not (np.isfinite(std).all() and (std >= 0).all()):
            raise ValueError(f"noise_std={known_noise}; expected numbers of at least 0")
        return np.maximum(std, NOISE_FLOOR * output_scale(self.system)) ** 2

    @property
    def label(self) -> str:
        """Its name in tables: the class attribute ``name``, or else the class's own."""
        return getattr(type(self), "name", type(self).__name__)

    @property
    def training(self) -> dict[str, Any]:
        """How it was trained, in plain numbers and strings; empty for those that are not."""
        return {}

    @property
    def options(self) -> dict[str, Any]:
        """Its own settings by name, beyond the model and the noise."""
        own = {f.name for f in fields(BaseEstimator)}
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in own and f.repr}


@dataclass(frozen=True)
class Estimator(BaseEstimator):
    """An online estimator: x̂(k|k) from y₀..y_k, for a batch of episodes at once.

    Its running state is explicit: `reset` makes one from the prior, and each `update` makes the
    next from one sample, the first of which is y₀.
    """

    track = "online"

    @abstractmethod
    def reset(self, prior: Prior) -> State:
        """The state before the first sample."""

    @abstractmethod
    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """The state after the sample at time t (s).

        Args:
            state: the state after the sample before, at an earlier time; steps may be irregular.
            t: the time of this sample.
            y: outputs, shape (batch, ny); NaN is a missing one.
            u: inputs, shape (batch, nu).
        """

    def run(self, record: Record) -> Estimates:
        """The estimates over whole records: `update` in a loop."""
        state = self._state_from("reset", self.reset(record.prior))
        columns: dict[str, np.ndarray] = {}
        y, u = np.moveaxis(record.y, 1, 0).copy(), np.moveaxis(record.u, 1, 0).copy()
        with np.errstate(all="ignore"):  # rows that diverge are marked by what they then hold
            for k, t in enumerate(record.t):
                state = self._state_from("update", self.update(state, float(t), y[k], u[k]))
                if k == 0:
                    columns = _empty_columns(state, record.num_samples)
                for name, column in columns.items():
                    column[k] = getattr(state, name)
        return Estimates(**{name: np.moveaxis(c, 0, 1) for name, c in columns.items()})

    def _state_from(self, method: str, state: Any) -> State:
        """What a method returned, if it is a state."""
        if not isinstance(state, State):
            name, kind = type(self).__name__, type(state).__name__
            raise TypeError(f"{name}.{method} returned {kind}; expected a State")
        return state


@dataclass(frozen=True)
class OfflineEstimator(BaseEstimator):
    """An estimator that sees an episode's whole record before it estimates any of it; it has `run`
    alone."""

    track = "offline"
    exempt_from: ClassVar[Mapping[str, str]] = {
        "causality": "it sees the whole record first",
        "run_equals_updates": "it has no update",
        "missing_samples": "it may need every sample",
        "irregular_times": "it may need equal steps",
        "diverging_row": "it may refuse a record that is not finite",
        "model_alone": "it may need outputs",
    }


def _empty_columns(state: State, num_samples: int) -> dict[str, np.ndarray]:
    """Arrays (num_samples, batch, ...) for what the state has, laid out in memory as it is.

    They are parts of one, because only of large arrays the memory comes in large pages: without,
    its first use took a tenth of the time of an extended Kalman filter.
    """
    held = {f.name: getattr(state, f.name) for f in fields(Estimates)}
    held = {name: array for name, array in held.items() if array is not None}
    room, used, columns = np.empty(num_samples * sum(a.size for a in held.values())), 0, {}
    for name, array in held.items():
        order = np.argsort([-stride for stride in array.strides], kind="stable")
        part = room[used : used + num_samples * array.size]
        column = part.reshape(num_samples, *(array.shape[axis] for axis in order))
        columns[name] = column.transpose(0, *(1 + np.argsort(order)))
        used += part.size
    return columns
