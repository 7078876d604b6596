"""The model integrated from the initial estimate: the baseline for all estimators."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class OpenLoop(RecursiveEstimator):
    """The model integrated from x̂₀, without use of the outputs.

    When to choose it: never, but as the baseline: what beats it has learned something from the
    outputs. Of a plant that contracts it may be enough, and then estimation is not needed.
    """

    name = "open_loop"
    template = "observer"
    computes = ("xhat",)
    equations = r"""
\dot{\hat x} &= f(t, \hat x, u), \qquad \hat x(t_0) = \hat x_0
"""
    knows = ("model", "prior")

    def reset(self, prior: Prior) -> State:
        return State(np.asarray(prior.mean, dtype=float))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        xhat = model_step(self.system, state.t, t, state.xhat, state.u, u)
        return State(xhat, state.t, state.u)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        return State(state.xhat, t=t, u=u)
