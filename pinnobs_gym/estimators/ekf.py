"""The extended Kalman filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.gaussian import (
    GaussianEstimator,
    checked,
    corrected,
    covariances,
    predicted,
)
from pinnobs_gym.estimation.kalman import innovation_covariance, observe
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.square_root import prior_root
from pinnobs_gym.estimation.wrapping import say_what_turns, wrapped_state
from pinnobs_gym.simulation.matrices import squared_size
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import vector
from pinnobs_gym.simulation.values import LARGEST


@dataclass(frozen=True)
class EKFMemory:
    """The filter's memory in addition to the fields of `State`. The batch is the last axis."""

    P_restart: np.ndarray
    """Covariances with which the gate restarts the filter, shape (nx, nx, batch)."""
    bounds: np.ndarray
    """The gate's bounds on the NIS of 0, 1, ... ny outputs, shape (ny + 1,)."""
    beyond: np.ndarray
    """Number of successive samples beyond the gate, shape (batch,)."""


@dataclass(frozen=True)
class EKF(RecursiveEstimator, GaussianEstimator):
    """The continuous-discrete extended Kalman filter (Jazwinski 1970, section 8.3).

    Between samples, the state and the variational flow Φ' = A(x̂)Φ are integrated by the classical
    Runge-Kutta method, and P⁻ = ΦPΦᵀ + Q. The update at a sample has Joseph's form, which keeps P
    symmetric and positive semidefinite. A missing output is left out of the update.

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.

    When to choose it: first. It is the cheapest filter with covariances, and the others are
    measured against it. Where it goes astray from a poor first guess, or f or h bend within a
    standard deviation, take `ukf` or `mhe`; for outliers `robust_ekf`.
    """

    gate: float | None = None
    """Probability, such as 0.9999, that the χ² bound on the normalised innovation squared (NIS)
    holds for a consistent filter (Bar-Shalom, Li & Kirubarajan 2001, section 5.4). After `patience`
    successive samples beyond the bound, the covariance is reset to P₀ + diag(scale²); never if
    None."""
    patience: int = 15
    """How many samples in a row may be beyond the gate."""
    huber: float | None = None
    """Number of standard deviations beyond which an innovation is down-weighted as in Huber's
    M-estimate, by enlarging the noise variance (one reweighting per sample; Huber 1964; Karlgaard &
    Schaub 2007); never if None. The value 1.345 is 95 % efficient on Gaussian noise."""

    name = "ekf"
    template = "ekf"
    equations = r"""
\dot{\hat x} &= f(t, \hat x, u), \qquad
\dot\Phi = \tfrac{\partial f}{\partial x}(t, \hat x, u)\, \Phi \\
P_k^- &= \Phi P_{k-1} \Phi^\top + Q, \qquad Q = \textstyle\int \Psi L L^\top \Psi^\top ds \\
e_k &= y_k - h(t_k, \hat x_k^-, u_k), \qquad
H = \tfrac{\partial h}{\partial x}(t_k, \hat x_k^-, u_k) \\
S &= H P_k^- H^\top + R, \qquad K = P_k^- H^\top S^{-1} \\
\hat x_k &= \hat x_k^- + K e_k \\
P_k &= (I - K H)\, P_k^- (I - K H)^\top + K R K^\top \\
\text{gate: } & P_k^- := P_0 + \operatorname{diag}(\mathrm{scale}^2)
\text{ after patience samples in a row with } e_k^\top S^{-1} e_k > \chi^2_{n_y, \mathrm{gate}} \\
\text{huber: } & R_{jj} := R_{jj} \max\bigl(1, |e_j| / (c \sqrt{S_{jj}})\bigr)
"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gate is not None and not 0 < self.gate < 1:
            raise ValueError(f"gate={self.gate}; expected a probability between 0 and 1")
        if self.patience < 1:
            raise ValueError(f"patience={self.patience}; expected at least 1 sample")
        if self.huber is not None and not self.huber >= 1 / LARGEST:
            expected = f"a number of at least {1 / LARGEST:g}"
            raise ValueError(f"huber={self.huber}; expected {expected}")

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        P0 = prior.cov
        wide = P0 + np.diag(vector(self.system.scale, self.system.nx, "scale") ** 2)
        bounds = self._gate_bounds()
        beyond = np.zeros(len(P0))
        memory = EKFMemory(wide.transpose(1, 2, 0), bounds, beyond)
        L = prior_root(self.system, prior, self.noise.R(0.0))
        return wrapped_state(self.system, State(prior.mean, P=P0, memory=memory, root=L))

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        state = predicted(self.system, state, covariances(state), self.noise, t, u)
        return wrapped_state(self.system, state)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        P, R = covariances(state), self.noise.R(t, y)
        say_what_turns(self.label, self.system, (t, y, u), state.xhat, P, R)
        innovation, H = observe(self.system, t, state.xhat, y, u)
        if self.gate is not None:
            state = self._gated(state, ~np.isnan(y), innovation, H, R)
            P = covariances(state)
        if self.huber is not None:
            R = self._reweighted(P, innovation, H, R)
        return corrected(state, (t, u), P, innovation, H, R)

    def plan_settings(self) -> dict[str, Any]:
        settings: dict[str, Any] = {"patience": self.patience, "huber": self.huber or 0.0}
        if self.gate is None:
            return settings
        return settings | {"gate": self._gate_bounds(), "carried": 1}

    def carried_memory(self, memory: EKFMemory) -> tuple[EKFMemory, dict[str, np.ndarray]]:
        if self.gate is None:
            return memory, {}
        memory = replace(memory, beyond=np.array(memory.beyond, dtype=float))
        return memory, {"carried": memory.beyond}

    def memory_rows(self, memory: EKFMemory, rows: np.ndarray) -> EKFMemory:
        return replace(memory, P_restart=memory.P_restart[..., rows], beyond=memory.beyond[rows])

    def with_memory_rows(self, memory: EKFMemory, rows: np.ndarray, part: EKFMemory) -> EKFMemory:
        beyond = memory.beyond.copy()
        beyond[rows] = part.beyond
        return replace(memory, beyond=beyond)

    def _gate_bounds(self) -> np.ndarray:
        """Return the gate's bounds on the NIS of 0, 1, ... ny outputs, which are χ² quantiles."""
        if self.gate is None:
            return np.full(self.system.ny + 1, np.inf)
        from scipy.special import gammaincinv

        degrees = np.maximum(np.arange(self.system.ny + 1), 1)
        return 2 * gammaincinv(degrees / 2, self.gate)

    def _gated(
        self,
        state: State,
        measured: np.ndarray,
        innovation: np.ndarray,
        H: np.ndarray,
        R: np.ndarray,
    ) -> State:
        """Return the prediction with P and its root reset where the gate restarts the filter, and
        with the updated memory; ``measured`` (batch, ny) tells which outputs are not missing. No
        output is left out: a sample without any neither counts as beyond the gate nor as within."""
        memory: EKFMemory = state.memory
        P, L = covariances(state), state.root
        present = measured.sum(axis=1)
        nis = squared_size(innovation, innovation_covariance(P, H, R))
        beyond = ~(nis <= memory.bounds[present])
        count = np.where(present > 0, np.where(beyond, memory.beyond + 1, 0), memory.beyond)
        restart = count >= self.patience
        if restart.any():
            say_once(
                f"{self.label} on {type(self.system).__name__}: {self.patience} samples in a row "
                "are beyond the gate; it restarts with the covariance P0 + diag(scale**2)"
            )
        P = np.where(restart, memory.P_restart, P)
        if L is not None:  # a row without a root keeps NaN
            wide = np.isfinite(L) & restart[:, None, None]
            L = np.where(wide, root(memory.P_restart).transpose(2, 0, 1), L)
        memory = replace(memory, beyond=np.where(restart, 0, count))
        return replace(state, P=P.transpose(2, 0, 1), memory=memory, root=L)

    def _reweighted(
        self, P: np.ndarray, innovation: np.ndarray, H: np.ndarray, R: np.ndarray
    ) -> np.ndarray:
        """Return R (ny, ny, batch) with enlarged variances for outputs with large innovations."""
        assert self.huber is not None
        std = np.sqrt(np.einsum("iib->ib", innovation_covariance(P, H, R)))
        excess = np.maximum(abs(innovation.T) / (self.huber * std), 1.0)
        return R * np.sqrt(excess[:, None] * excess)  # correlations stay
