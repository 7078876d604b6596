"""Estimators with two steps: a prediction between samples and a correction at each sample."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, final

import numpy as np

from pinnobs_gym.estimation.compiled import Compiled, CompiledFilter, compiled_filter
from pinnobs_gym.estimation.estimator import Estimates, Estimator, State
from pinnobs_gym.simulation.record import Prior, Record

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode
    from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary


@dataclass(frozen=True)
class RecursiveEstimator(Estimator):
    """An online estimator whose update is a prediction to the time of the sample, followed by a
    correction with the outputs. At the first sample the prior serves as the prediction.

    Subclasses define `reset`, `predict` and `correct`. One that defines `update` is refused with a
    TypeError; it derives from `Estimator` instead.
    """

    template: ClassVar[str] = ""
    """The template of `pinnobs_gym.simulation.kernels` that computes the same; empty if there is
    none. It is not used for a subclass that overrides a method of the class that names it."""
    computes: ClassVar[tuple[str, ...]] = ("xhat", "P", "innovation", "S")
    """The fields of `Estimates` that the estimator has, if there is a template."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        if cls.update is not RecursiveEstimator.update:
            raise TypeError(
                f"{cls.__name__} defines update; expected predict and correct, or a subclass of "
                "Estimator"
            )

    @abstractmethod
    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        """Return the state with the prediction for the next sample.

        Its ``xhat`` is x̂(k|k−1), and its ``P``, if the estimator computes it here, the covariance
        of that. The time and the inputs stay those of the previous sample.

        Args:
            state: the state after the previous sample.
            t: time of the next sample in s.
            u: inputs at the next sample, shape (batch, nu).
        """

    @abstractmethod
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after the sample at time t.

        Args:
            state: the result of `predict`, whose ``t`` is the time of the previous sample; at the
                first sample the result of `reset`, whose ``t`` is None.
            t: time of the sample in s.
            y: outputs, shape (batch, ny); NaN marks a missing output.
            u: inputs, shape (batch, nu).
        """

    @final
    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        compiled = self.compiled
        if compiled is not None:
            after = compiled.update(state, t, y, u)
            if after is not None:
                return after
        return self.update_by_numpy(state, t, y, u)

    def run(self, record: Record) -> Estimates:
        compiled = self.compiled
        estimates = None if compiled is None else compiled.run(record)
        return super().run(record) if estimates is None else estimates

    @final
    def update_by_numpy(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after the sample at time t by `predict` and `correct`, which compiled
        code has to agree with; see `update`."""
        if state.t is not None:
            state = _state_from(self, "predict", self.predict(state, t, u))
        return _state_from(self, "correct", self.correct(state, t, y, u))

    @cached_property
    def compiled(self) -> Compiled | None:
        """The compiled code of the estimator; None if it is computed in NumPy."""
        found = compiled_filter(self)
        return None if isinstance(found, str) else found

    def compiled_with(self, made: PlantLibrary) -> Compiled:
        """Return the compiled code of the estimator in a library of its template."""
        return CompiledFilter(self, made)

    def not_compiled(self) -> str:
        """Return in one line why the template does not compute the same with the estimator's
        settings, an empty text if it does."""
        return ""

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        from pinnobs_gym.estimation.export.filters import EXPORTED, filter_code

        return filter_code(self, code, prior) if self.template in EXPORTED else None

    def ask_model(self) -> None:
        # Compiled filters contain the model's steps. Rows that sets of points leave to NumPy take
        # the same steps whatever else the process has asked for.
        if not isinstance(self.compiled, CompiledFilter):
            super().ask_model()

    def plan_settings(self) -> dict[str, Any]:
        """Return the settings that the compiled code takes, by the fields of ``struct plan``."""
        return {}

    def carried_memory(self, memory: Any) -> tuple[Any, dict[str, np.ndarray]]:
        """Return the memory of the next state, given that of the last one, and those of its arrays,
        by the fields of ``struct call``, that the compiled code reads and changes."""
        return memory, {}

    def given_noise(self, memory: Any) -> np.ndarray | None:
        """Return the covariance of the output noise of all samples, (ny, ny, batch or 1), that a
        memory has in place of the known one; None if it has none."""
        return None

    def memory_rows(self, memory: Any, rows: np.ndarray) -> Any:
        """Return the memory of some rows of the batch."""
        return memory

    def with_memory_rows(self, memory: Any, rows: np.ndarray, part: Any) -> Any:
        """Return the memory with that of some rows of the batch replaced."""
        return memory


def _state_from(estimator: RecursiveEstimator, method: str, state: Any) -> State:
    """Return the result of a method, and check that it is a `State`.

    Raises:
        TypeError: in one line, if it is not.
    """
    if not isinstance(state, State):
        name, kind = type(estimator).__name__, type(state).__name__
        raise TypeError(f"{name}.{method} returned {kind}; expected a State")
    return state
