"""The model alone, from the initial estimate: the row that everything must beat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class OpenLoop(Estimator):
    """The model integrated from x̂₀ without looking at the output."""

    name = "open_loop"
    equations = r"""
\dot{\hat x} &= f(t, \hat x, u), \qquad \hat x(t_0) = \hat x_0
"""
    knows = ("model", "prior")

    def reset(self, prior: Prior) -> State:
        return State(np.asarray(prior.mean, dtype=float))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        xhat = state.xhat
        if state.t is not None:
            xhat = model_step(self.system, state.t, t, xhat, state.u, u)
        return State(xhat, t=t, u=u)
