"""The interface of all estimators, and its application to whole records."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import Field, dataclass, field, fields
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np

from pinnobs_gym.estimation.given import checked_reset, checked_run, checked_update
from pinnobs_gym.estimation.hints import check_settings
from pinnobs_gym.estimation.takes import EVERYTHING, check_taken
from pinnobs_gym.registry import did_you_mean, trainer_class
from pinnobs_gym.simulation.declared import check_fields
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.noise import AssumedNoise, Level, SampledLevel
from pinnobs_gym.simulation.probe import probe
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.shown import call_of, html, summary_of
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.simulation.values import check_parameters, shortly

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode


@dataclass(frozen=True)
class State:
    """The running state of an estimator for a batch of episodes. The row of an episode whose
    estimate has diverged contains non-finite values."""

    xhat: np.ndarray
    """Estimates x̂(k|k), shape (batch, nx)."""
    t: float | None = None
    """Time of the last sample in s; None before the first."""
    u: np.ndarray | None = None
    """Inputs at the last sample, shape (batch, nu); None before the first."""
    P: np.ndarray | None = None
    """Covariances of the estimates, shape (batch, nx, nx), if the estimator computes them."""
    innovation: np.ndarray | None = None
    """Innovations y − h(t, x̂(k|k−1), u), shape (batch, ny); zero where y is missing."""
    S: np.ndarray | None = None
    """Covariances of the innovations, shape (batch, ny, ny)."""
    memory: Any = None
    """Any further state of the estimator."""
    root: np.ndarray | None = None
    """Roots L of P = LLᵀ, shape (batch, nx, nx), of the episodes that need them, see
    `pinnobs_gym.estimation.square_root`; NaN in other rows, and None if there are no such rows."""
    outside: np.ndarray | None = None
    """Of estimators that were trained: 1 where the estimate is that of a fallback, since the sample
    is outside of what they were trained on, else 0; shape (batch,)."""
    packed: Any = field(default=None, init=False, repr=False, compare=False)
    """The buffer of which the arrays are views, if compiled code computed them. A state with a
    value replaced has none, nor has one that is copied or comes from another process."""


@dataclass(frozen=True)
class Estimates:
    """The estimates for a batch of records, with what else the estimator computes. The fields are
    those of `State`, at every sample."""

    xhat: np.ndarray
    """Estimates, shape (batch, num_samples, nx): x̂(k|k), or x̂(k|n) of an offline estimator."""
    P: np.ndarray | None = None
    """Covariances of the estimates, shape (batch, num_samples, nx, nx)."""
    innovation: np.ndarray | None = None
    """Innovations, shape (batch, num_samples, ny)."""
    S: np.ndarray | None = None
    """Covariances of the innovations, shape (batch, num_samples, ny, ny)."""
    outside: np.ndarray | None = None
    """Of estimators that were trained: 1 where the estimate is that of a fallback, since the sample
    is outside of what they were trained on, else 0; shape (batch, num_samples)."""


@dataclass(frozen=True)
class Range:
    """The search range of a setting, in integers if both bounds are integers."""

    low: float
    high: float
    log: bool = False
    """Whether the search is over the logarithm of the setting."""

    @property
    def whole(self) -> bool:
        """Whether the range consists of integers."""
        return isinstance(self.low, int) and isinstance(self.high, int)


@dataclass(frozen=True)
class BaseEstimator(ABC):
    """The base class of online estimators (`Estimator`) and offline ones (`OfflineEstimator`).

    Estimators are immutable. An estimator is given outputs, inputs, the prior, the noise level and
    the model, which may differ from the true plant. It has no access to the true state, the reward
    or an env's ``info``.
    """

    system: System
    """The model of the plant."""
    noise_std: Level | SampledLevel | None = None
    """Output noise known to the estimator, as `Setup.noise_std` or by sample; that of the setup
    ``benchmark`` if None."""
    process_noise: Level | None = None
    """Process noise known to the estimator, as `Setup.process_noise`; that of the setup
    ``benchmark`` if None."""

    track: ClassVar[str]
    """``online`` (causal) or ``offline`` (uses the whole record); the two are ranked separately."""
    trains_on_record: ClassVar[str | None] = None
    """Trainer that the estimator runs on every record, if any, given as in `needs_training`."""
    knows: ClassVar[tuple[str, ...]] = ("model", "prior", "noise")
    """The information given to the estimator in addition to the outputs and inputs."""
    needs_training: ClassVar[str | None] = None
    """Trainer whose result the estimator requires, if any: its name or ``module:Class``. A name is
    first looked for in the estimator's own module."""
    tunable: ClassVar[Mapping[str, Range]] = {}
    """Search ranges of the settings that ``pinnobs tune`` searches."""
    recipe: ClassVar[Mapping[str, Any]] = {}
    """Default choices for this estimator in the Config of its trainer, see `trainer_config`."""
    variants: ClassVar[tuple[Mapping[str, Any], ...]] = ({},)
    """Choices in the Config of its trainer, each of which a suite without a list of estimators
    plays separately."""
    exempt_from: ClassVar[Mapping[str, str]] = {}
    """Checks of `pinnobs_gym.estimation.checks.check_estimator` that do not apply to the estimator,
    by name, with the reason in one line."""
    takes: ClassVar[frozenset[str]] = EVERYTHING
    """What a plant may have: names of `pinnobs_gym.estimation.takes.FEATURES` that the estimator
    uses, or on which its estimates do not depend. A system with another one is refused, its cells
    in a leaderboard are not applicable, and checks of that feature are left out."""
    equations: ClassVar[str] = ""
    """The equations in LaTeX for the estimator's page, one per line as in an ``aligned``
    environment. φ is the model's flow from the previous sample; a raised minus marks quantities
    before the correction by y_k."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        checks = {"run": checked_run, "reset": checked_reset, "update": checked_update}
        if "__repr__" not in vars(cls):  # which a dataclass would write of all fields
            cls.__repr__ = BaseEstimator.__repr__
        for name, check in checks.items():
            if name in vars(cls) and not getattr(vars(cls)[name], "__isabstractmethod__", False):
                setattr(cls, name, check(vars(cls)[name]))

    def __repr__(self) -> str:
        told = [f for f in fields(BaseEstimator) if f.name != "system"]
        return call_of(self, repr(self.system), chosen=[*told, *self.setting_fields()])

    def _repr_html_(self) -> str:
        rows = [(name, shortly(value)) for name, value in self.options.items()]
        rows += [("track", self.track), ("knows", ", ".join(self.knows))]
        return html(repr(self), summary_of(type(self)), ("setting", "value"), rows)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "compiled"}

    def __post_init__(self) -> None:
        probe(type(self.system))
        check_parameters(type(self.system), self.system.parameters)
        noise = self.system.noise(self.noise_std, self.process_noise)  # raises for a wrong level
        check_taken(type(self), self.system, noise)
        check_fields(type(self))
        check_settings(self, self.setting_fields())

    def ask_model(self) -> None:
        """Ask for the compiled steps of the model, which are used from then on."""
        ask(self.system, "model")

    @classmethod
    def for_setup(cls, system: System, setup: Setup, **options: Any) -> Self:
        """Return the estimator for a model, with a setup's noise and the given settings.

        Raises:
            ValueError: in one line, if a setting is unknown or a value is not allowed.
        """
        shared = {f.name for f in fields(BaseEstimator)}
        taken = {f.name for f in fields(cls) if f.init} - shared
        for name in options:
            if name not in taken:
                known = sorted(f.name for f in cls.setting_fields() if f.init)
                expected = f"one of {', '.join(known)}" if known else "no settings"
                raise ValueError(
                    f"setting {name!r}; expected {expected}{did_you_mean(name, known)}"
                )
        return cls(system, setup.noise_std, setup.process_noise, **options)

    @classmethod
    def trainer_config(cls, changes: Mapping[str, Any]) -> Any:
        """Return the Config of the estimator's trainer: that of its `recipe`, with some settings
        changed as by `pinnobs_gym.training.trainer.Trainer.configured`.

        Raises:
            ValueError: in one line, if a setting is unknown or a value is not allowed.
        """
        return trainer_class(cls).configured({**cls.recipe, **changes})

    @abstractmethod
    def run(self, record: Record) -> Estimates:
        """Return the estimates for a batch of records.

        Raises:
            ValueError: in one line, if the record does not fit the system, see
                `Record.check_fits`. The check precedes the method of any subclass.
        """

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        """Return the code of the estimator beside the equations of its model, for C files (see
        `pinnobs_gym.estimation.export.c_files`); None if it is not written as C.

        Args:
            code: the model's equations in C.
            prior: the prior that it starts from, of one row.

        Raises:
            ValueError: in one line, if the estimator does something that the code does not.
        """
        return None

    @cached_property
    def noise(self) -> AssumedNoise:
        """The noise that the estimator assumes: that which it is told, with an output noise above
        zero."""
        return AssumedNoise.of(self.system, self.system.noise(self.noise_std, self.process_noise))

    @property
    def label(self) -> str:
        """Name in tables: the class attribute ``name`` or, without it, the name of the class, and
        the recipe of its training if its trainer has several."""
        name = getattr(type(self), "name", type(self).__name__)
        return labelled(name, self.training.get("recipe", ""))

    @property
    def training(self) -> dict[str, Any]:
        """Description of the training in plain numbers and strings; empty without training. Its
        ``recipe`` is part of the `label`, and what its ``knows`` lists adds to `knows`."""
        return {}

    @property
    def options(self) -> dict[str, Any]:
        """The estimator's settings by name, without the model and the noise level."""
        return {f.name: getattr(self, f.name) for f in self.setting_fields()}

    @classmethod
    def setting_fields(cls) -> list[Field[Any]]:
        """Return the fields of the estimator's settings."""
        shared = {f.name for f in fields(BaseEstimator)}
        return [f for f in fields(cls) if f.name not in shared and f.repr]


@dataclass(frozen=True)
class Estimator(BaseEstimator):
    """An online estimator: it computes x̂(k|k) from y₀..y_k for a batch of episodes.

    The running state is an explicit value: `reset` returns the initial state from the prior, and
    each `update` returns the next state from one sample. The first sample is y₀.
    """

    track = "online"

    @abstractmethod
    def reset(self, prior: Prior) -> State:
        """Return the state before the first sample."""

    @abstractmethod
    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after the sample at time t.

        Args:
            state: the state after the previous sample, or that of `reset`.
            t: time of the sample in s, later than ``state.t``; steps may be irregular. That of a
                map is a whole number.
            y: outputs, shape (batch, ny), finite; NaN marks a missing output.
            u: inputs, shape (batch, nu), finite: those that `System.input` defines, unless the
                system has `System.measured_input`.

        Raises:
            ValueError: in one line, if an argument is not that, as for a `Record`. The check
                precedes the method of any subclass.
        """

    def run(self, record: Record) -> Estimates:
        """Return the estimates for a batch of records, from one `update` per sample."""
        state = self.reset(record.prior)
        columns: dict[str, np.ndarray] = {}
        update = type(self).update
        update = getattr(update, "unchecked", update)  # the record is checked as a whole
        y, u = np.moveaxis(record.y, 1, 0).copy(), np.moveaxis(record.u, 1, 0).copy()
        with np.errstate(all="ignore"):  # diverged rows are marked by their non-finite values
            for k, t in enumerate(record.t):
                state = update(self, state, float(t), y[k], u[k])
                if k == 0:
                    columns = _empty_columns(state, record.num_samples)
                for name, column in columns.items():
                    column[k] = getattr(state, name)
        return Estimates(**{name: np.moveaxis(c, 0, 1) for name, c in columns.items()})


@dataclass(frozen=True)
class OfflineEstimator(BaseEstimator):
    """An estimator that uses the whole record of an episode for each of its estimates. It has only
    the method `run`."""

    track = "offline"
    exempt_from: ClassVar[Mapping[str, str]] = {
        "causality": "it sees the whole record first",
        "run_equals_updates": "it has no update",
        "missing_samples": "it may need every sample",
        "irregular_times": "it may need equal steps",
        "diverging_row": "it may refuse a record that is not finite",
        "model_alone": "it may need outputs",
        "blank_rows": "it may need an output at every row",
        "sampled_noise": "it may need every sample",
        "held_input": "it may need outputs",
    }


def labelled(name: str, recipe: str) -> str:
    """Return the name in tables of an estimator trained by a recipe; see
    `pinnobs_gym.training.settings.TrainingConfig.recipe`."""
    return f"{name} ({recipe})" if recipe else name


def _empty_columns(state: State, num_samples: int) -> dict[str, np.ndarray]:
    """Return empty arrays (num_samples, batch, ...) for the fields that the state has, in the
    memory order of these fields.

    The arrays are views of a single one, because only large arrays are allocated in large memory
    pages. With separate arrays, the first access to their memory took a tenth of the run time of an
    extended Kalman filter.
    """
    arrays = {f.name: getattr(state, f.name) for f in fields(Estimates)}
    arrays = {name: array for name, array in arrays.items() if array is not None}
    buffer, used, columns = np.empty(num_samples * sum(a.size for a in arrays.values())), 0, {}
    for name, array in arrays.items():
        order = np.argsort([-stride for stride in array.strides], kind="stable")
        part = buffer[used : used + num_samples * array.size]
        column = part.reshape(num_samples, *(array.shape[axis] for axis in order))
        columns[name] = column.transpose(0, *(1 + np.argsort(order)))
        used += part.size
    return columns
