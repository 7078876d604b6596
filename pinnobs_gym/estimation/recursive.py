"""Estimators in two steps: the prediction between samples, and the correction at one."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import final

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State


@dataclass(frozen=True)
class RecursiveEstimator(Estimator):
    """An online estimator whose update is a prediction to the time of the sample, then a
    correction by its outputs; at the first sample, which the prior stands for, the correction
    alone."""

    @abstractmethod
    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        """The prediction x̂(k|k−1) at the time t (s) of the next sample, and its covariance.

        The other fields, time and inputs among them, stay those of the sample before.

        Args:
            state: the state after the sample before.
            t: the time of the next sample in s.
            u: inputs at the next sample, shape (batch, nu).
        """

    @abstractmethod
    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """The state after the sample at time t (s).

        Args:
            state: the prediction, whose `State.t` is the time of the sample before; at the first
                sample the state of `reset`, whose time is None.
            t: the time of this sample in s.
            y: outputs, shape (batch, ny); NaN is a missing one.
            u: inputs, shape (batch, nu).
        """

    @final
    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        if state.t is not None:
            state = self.predict(state, t, u)
        return self.correct(state, t, y, u)
