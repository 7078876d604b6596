"""The Kalman-like high-gain observer."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.estimator import Range, State
from pinnobs_gym.estimation.gaussian import (
    GaussianEstimator,
    checked,
    corrected,
    covariances,
    predicted,
)
from pinnobs_gym.estimation.kalman import observe, predict
from pinnobs_gym.estimation.observer_gains import default_rate
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.square_root import prior_root
from pinnobs_gym.simulation.matrices import sandwich, total
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import vector

if TYPE_CHECKING:
    from pinnobs_gym.estimation.export.algorithm import Algorithm
    from pinnobs_gym.simulation.kernels.plant_code import PlantCode


@dataclass(frozen=True)
class HighGainMemory:
    """What the limit of P follows from, shape (batch,) each. Sizes are sums of variances over
    scale²."""

    largest: np.ndarray
    """Size beyond which P is not to grow by forgetting."""
    size: np.ndarray
    """Size of P after the last sample with an output."""
    last: np.ndarray
    """Time of that sample in s, or of the first one."""
    added: np.ndarray | None = None
    """The part of P that process noise has added since that sample, shape (nx, nx, batch), which is
    not forgotten before the next one; None without process noise, or with roots."""


@dataclass(frozen=True)
class HighGain(RecursiveEstimator, GaussianEstimator):
    """The high-gain observer with exponential forgetting (Bornard, Couenne & Celle 1989; Deza et
    al. 1992): x̂' = f(t, x̂, u) + S⁻¹HᵀR⁻¹(y − h(t, x̂, u)), Ṡ = −θS − AᵀS − SA + HᵀR⁻¹H.

    S⁻¹ = P is propagated as a covariance: it becomes ΦPΦᵀ·exp(θ·dt) between samples, and the update
    at a sample has Joseph's form. Forgetting of old outputs at the rate θ takes the place of
    process noise. Without a limit, P would grow without bound in directions that the outputs do not
    determine. From the last sample with an output on, the factor is therefore no larger than that
    which makes the P of this sample as large as P₀ + diag(scale²), as measured by the sum of the
    variances over scale². Samples without any output do not change what is forgotten: process noise
    since the last output is none of it (but where a very wide prior is computed with roots).

    Default tuning is the same rule for all systems: P₀ is that of the prior, the noise is the known
    one, and a benchmark episode lasts 20 time constants 1/θ.

    When to choose it: where a single number, the rate of forgetting, is to be all the tuning, and
    the outputs have little noise, which a high gain amplifies. Where the noise of the plant is
    known, `ekf`.
    """

    assumed_noise: float = 0.0
    """Standard deviation of process noise that is assumed beyond the known one, over each state's
    scale and the benchmark's duration; by default none, as forgetting takes its place."""
    theta: float | None = None
    """Forgetting rate θ in 1/s; 20 time constants per benchmark episode if None."""

    name = "high_gain"
    template = "high_gain"
    equations = r"""
\dot{\hat x} &= f(t, \hat x, u), \qquad
P_k^- = g\, \Phi P_{k-1} \Phi^\top + Q \\
g &= \min\Bigl( e^{\theta (t_k - t_{k-1})}, \max\Bigl( 1,
\frac{p(P_0 + \operatorname{diag}(\mathrm{scale}^2))}{p(P_{k-1})} \Bigr) \Bigr), \qquad
p(P) = \textstyle\sum_i P_{ii} / \mathrm{scale}_i^2 \\
K &= P_k^- H^\top (H P_k^- H^\top + R)^{-1} \\
\hat x_k &= \hat x_k^- + K\, (y_k - h(t_k, \hat x_k^-, u_k)) \\
P_k &= (I - K H)\, P_k^- (I - K H)^\top + K R K^\top
"""
    tunable = {"theta": Range(0.1, 1e3, log=True)}

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.theta is not None and not 0 <= self.theta < np.inf:
            raise ValueError(f"theta={self.theta}; expected a number of at least 0")

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        size = self._size(prior.cov.transpose(1, 2, 0))
        L = prior_root(self.system, prior, self.noise.R(0.0))
        added = None
        if self.noise.stochastic and L is None:
            added = np.zeros((self.system.nx, self.system.nx, len(size)))
        memory = HighGainMemory(size + self.system.nx, size, np.full(len(size), np.nan), added)
        return State(prior.mean, P=prior.cov, memory=memory, root=L)

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        growth = self._growth(state.memory, t) - self._growth(state.memory, state.t)
        P, memory = covariances(state), state.memory
        if memory.added is not None:
            P = (P - memory.added) * np.exp(growth) + memory.added
            ends = (state.t, t), state.xhat, P, self.noise, (state.u, u)
            xhat, P, F, Q = predict(self.system, *ends)
            memory = replace(memory, added=sandwich(F, memory.added) + Q)
            covariance = P.transpose(2, 0, 1)
            return State(xhat, state.t, state.u, covariance, state.innovation, None, memory)
        P = P * np.exp(growth)
        if state.root is not None:
            state = replace(state, root=state.root * np.exp(growth / 2)[:, None, None])
        return predicted(self.system, state, P, self.noise, t, u)

    def _growth(self, memory: HighGainMemory, t: float) -> np.ndarray:
        """Return the logarithms (batch,) of the factors by which P has grown at time t (s) since
        the last sample with an output."""
        theta = self._theta()
        with np.errstate(divide="ignore", invalid="ignore"):  # a size is 0 if all states are known
            allowed = np.maximum(np.log(memory.largest / memory.size), 0.0)
        return np.minimum(theta * (t - memory.last), allowed)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        P, R = covariances(state), self.noise.R(t, y)
        innovation, H = observe(self.system, t, state.xhat, y, u)
        new = corrected(state, (t, u), P, innovation, H, R)
        memory: HighGainMemory = state.memory
        seen = ~np.isnan(y).all(axis=1) | np.isnan(memory.last)
        size = np.where(seen, self._size(covariances(new)), memory.size)
        added = None if memory.added is None else np.where(seen, 0.0, memory.added)
        last = np.where(seen, t, memory.last)
        memory = replace(memory, size=size, last=last, added=added)
        return replace(new, memory=memory)

    def _theta(self) -> float:
        """Return θ in 1/s."""
        return default_rate(self.system) if self.theta is None else self.theta

    def plan_settings(self) -> dict[str, Any]:
        system = self.system
        carried = 4 + system.nx**2 if self.noise.stochastic else 3
        per_scale = vector(system.scale, system.nx, "scale") ** -2
        return {"theta": self._theta(), "per_scale": per_scale, "carried": carried}

    def carried_memory(
        self, memory: HighGainMemory
    ) -> tuple[HighGainMemory, dict[str, np.ndarray]]:
        parts, added = [memory.largest, memory.size, memory.last], memory.added
        if self.noise.stochastic:
            nx, batch = self.system.nx, len(memory.size)
            known = np.full(batch, float(added is not None))
            kept = np.zeros((nx, nx, batch)) if added is None else added
            parts += [known, *kept.reshape(nx * nx, batch)]
        carried = np.array(parts, dtype=float)
        largest, size, last = carried[:3]
        if added is not None:
            added = carried[4:].reshape(added.shape)
        return HighGainMemory(largest, size, last, added), {"carried": carried}

    def memory_rows(self, memory: HighGainMemory, rows: np.ndarray) -> HighGainMemory:
        added = None if memory.added is None else memory.added[..., rows]
        return HighGainMemory(memory.largest[rows], memory.size[rows], memory.last[rows], added)

    def with_memory_rows(
        self, memory: HighGainMemory, rows: np.ndarray, part: HighGainMemory
    ) -> HighGainMemory:
        size, last = memory.size.copy(), memory.last.copy()
        size[rows], last[rows] = part.size, part.last
        added = memory.added
        if added is not None and part.added is not None:
            added = added.copy()
            added[..., rows] = part.added
        return HighGainMemory(memory.largest, size, last, added)

    def exported(self, code: PlantCode, prior: Prior) -> Algorithm | None:
        return None

    def _size(self, P: np.ndarray) -> np.ndarray:
        """Return the sum of the variances in P (nx, nx, batch) over scale², shape (batch,)."""
        scale = vector(self.system.scale, self.system.nx, "scale")
        return total(np.einsum("iib->ib", P) * scale[:, None] ** -2)
