"""Estimators with two steps: a prediction between samples and a correction at each sample."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State


@dataclass(frozen=True)
class RecursiveEstimator(Estimator):
    """An online estimator whose update is a prediction to the time of the sample, followed by a
    correction with the outputs. At the first sample the prior serves as the prediction.

    Subclasses define `reset`, `predict` and `correct`. One that defines `update` is refused with a
    TypeError; it derives from `Estimator` instead.
    """

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
        if state.t is not None:
            state = self._state_from("predict", self.predict(state, t, u))
        return self._state_from("correct", self.correct(state, t, y, u))
