"""The common base of observers that correct by a constant gain over the time since a sample."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.observer_gains import injection, time_since
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.value_shape import outputs_at


@dataclass(frozen=True)
class ConstantGainObserver(RecursiveEstimator):
    """An observer x̂' = f(t, x̂, u) + L·s(e), e = y − h(t, x̂, u), with a constant gain L, and s of
    each output its innovation times a secant.

    At a sample it applies the correction over the time since the output's previous sample, by
    Euler's implicit method (`pinnobs_gym.estimation.observer_gains.injection`). Its memory is L,
    and the time of each output's last sample, (batch, ny), NaN before the first.
    """

    computes = ("xhat", "innovation")

    @abstractmethod
    def designed(self) -> np.ndarray:
        """Return the gain L, shape (nx, ny), in state units per output unit and s."""

    def secant(self, innovation: np.ndarray, t: float) -> np.ndarray | float:
        """Return s(e)/e, a number or (batch, ny), for innovations e (batch, ny) at time t (s)."""
        return 1.0

    def reset(self, prior: Prior) -> State:
        L = np.asarray(self.designed(), dtype=float)
        last = np.full((len(prior.mean), self.system.ny), np.nan)
        return State(prior.mean.astype(float), memory=(L, last))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        xhat = model_step(self.system, state.t, t, state.xhat, state.u, u)
        return State(xhat, state.t, state.u, memory=state.memory)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        xhat, (L, last) = state.xhat, state.memory
        missing = np.isnan(y)
        dt, last = time_since(last, t, missing)
        innovation = self.system.output_residual(y, outputs_at(self.system, t, xhat, u))
        innovation = np.where(missing, 0.0, innovation)
        H = np.asarray(self.system.h_jacobian(t, xhat, u))
        K = injection(L, H, dt * self.secant(innovation, t))
        xhat = xhat + (K @ innovation[..., None])[..., 0]
        return State(xhat, t, u, innovation=innovation, memory=(L, last))

    def plan_settings(self) -> dict[str, Any]:
        return {"carried": self.system.ny}

    def carried_memory(self, memory: Any) -> tuple[Any, dict[str, np.ndarray]]:
        L, last = memory
        L, own = np.ascontiguousarray(L), np.array(last.T, dtype=float, order="C")
        return (L, own.T), {"gain": L, "carried": own}

    def memory_rows(self, memory: Any, rows: np.ndarray) -> Any:
        L, last = memory
        return L, last[rows]

    def with_memory_rows(self, memory: Any, rows: np.ndarray, part: Any) -> Any:
        L, last = memory
        last = last.copy()
        last[rows] = part[1]
        return L, last
