"""Moving-horizon estimation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, Range, State
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked
from pinnobs_gym.estimation.kalman import joseph_update, observe, predict
from pinnobs_gym.estimation.least_squares import Fit, linearised
from pinnobs_gym.simulation.matrices import cholesky, divide, identity, product, sandwich
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class WindowMemory:
    """The window, and what is known of its start; in matrices the batch comes last."""

    Q: np.ndarray
    """Covariance of the process noise, shape (nx, nx, 1)."""
    R: np.ndarray
    """Covariance of the output noise, shape (ny, ny, 1)."""
    arrival: np.ndarray
    """x̄, the estimate of the window's first state from all samples before it, (batch, nx)."""
    P: np.ndarray
    """Its covariance, shape (nx, nx, batch)."""
    start: np.ndarray
    """The window's first state as the samples in it correct it, shape (batch, nx)."""
    t: tuple[float, ...] = ()
    """Times of the window's samples in s."""
    y: tuple[np.ndarray, ...] = ()
    """Their outputs, (batch, ny) each."""
    u: tuple[np.ndarray, ...] = ()
    """Their inputs, (batch, nu) each."""


@dataclass(frozen=True)
class MHE(Estimator, GaussianEstimator):
    """Moving-horizon estimation (Rao, Rawlings & Mayne 2003): the model's trajectory over the last
    samples that is nearest to their outputs and to what was known before them.

    At every sample some Gauss-Newton steps go down
    (x − x̄)ᵀP̄⁻¹(x − x̄) + Σ(y − h)ᵀR⁻¹(y − h) over the window's first state x, from where the last
    sample left it. When a sample leaves the window, x̄ and P̄ take it in as an extended Kalman filter
    does that is linearised about x. Within the window the model is taken as exact. A window longer
    than the record is the whole of it.

    Default tuning, the same rule for all systems: P₀ from the prior, R from the noise level it is
    given (`BaseEstimator.output_variance`), Q = (`process_noise`·scale)² between windows.
    """

    process_noise: float = 2e-5
    """Standard deviation of the process noise per sample, over the state's scale."""
    window: int = 10
    """Samples in the window."""
    steps: int = 1
    """Gauss-Newton steps at every sample; one is the real-time iteration of Diehl et al. 2005."""

    name = "mhe"
    equations = r"""
x_{k-N+1} &= \arg\min_x \; (x - \bar x)^\top \bar P^{-1} (x - \bar x)
+ \sum_{j=k-N+1}^{k} \bigl\| y_j - h(t_j, \varphi_j(x), u_j) \bigr\|^2_{R^{-1}} \\
\hat x_k &= \varphi_k(x_{k-N+1}), \qquad
G_j = \tfrac{\partial h(t_j, \varphi_j, u_j)}{\partial x}, \quad
\Phi = \tfrac{\partial \varphi_k}{\partial x} \\
P_k &= \Phi \Bigl( \bar P^{-1} + \sum_j G_j^\top R^{-1} G_j \Bigr)^{-1} \Phi^\top
"""
    tunable = {**GaussianEstimator.tunable, "window": Range(2, 40, log=True)}

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("window", "steps"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}={getattr(self, name)}; expected at least 1")

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        P0, mean = prior.cov.transpose(1, 2, 0), prior.mean
        return State(mean, P=prior.cov, memory=WindowMemory(*self.tuning(), mean, P0, mean))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: WindowMemory = state.memory
        if len(memory.t) == self.window:
            memory = self._moved(memory, t, u)
        memory = replace(memory, t=(*memory.t, t), y=(*memory.y, y), u=(*memory.u, u))
        start = memory.start
        fit = self._fit(memory, start)
        innovation, H = observe(self.system, t, fit.x[-1], y, u)
        step, P = _step(fit, memory.P, memory.arrival - start)
        for _ in range(self.steps - 1):
            start = start + step
            fit = self._fit(memory, start)
            step, P = _step(fit, memory.P, memory.arrival - start)
        start = start + step
        xhat = fit.x[-1] + np.einsum("ijb,bj->bi", fit.X[-1], step)
        P = sandwich(fit.X[-1], P)
        memory = replace(memory, start=start)
        S = _innovation_covariance(P, H, memory.R).transpose(2, 0, 1)
        P = ((P + P.transpose(1, 0, 2)) / 2).transpose(2, 0, 1)
        return State(xhat, t, u, P, innovation, S, memory)

    def _fit(self, memory: WindowMemory, start: np.ndarray) -> Fit:
        """The model's trajectory through the window from a state at its start."""
        nx, batch = self.system.nx, len(start)
        X = identity(nx, batch)
        R = np.diagonal(memory.R[..., 0])
        return linearised(self.system, memory.t, memory.y, memory.u, start, X, R)

    def _moved(self, memory: WindowMemory, t: float, u: np.ndarray) -> WindowMemory:
        """The window without its first sample, which x̄ and P̄ take in."""
        start = memory.start
        innovation, H = observe(self.system, memory.t[0], start, memory.y[0], memory.u[0])
        ahead = memory.arrival - start
        innovation = innovation - np.einsum("pib,bi->bp", H, ahead)
        ahead, P, _ = joseph_update(ahead, memory.P, innovation, H, memory.R)
        second, u_second = (*memory.t, t)[1], (*memory.u, u)[1]
        times, inputs = (memory.t[0], second), (memory.u[0], u_second)
        start, P, F = predict(self.system, times, start, P, memory.Q, inputs)
        arrival = start + product(F, ahead.T[:, None])[:, 0].T
        memory = replace(memory, t=memory.t[1:], y=memory.y[1:], u=memory.u[1:])
        return replace(memory, arrival=arrival, P=P, start=start)


def _innovation_covariance(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """S = HP⁻Hᵀ + R, (ny, ny, batch), of the covariance P after the update: R(R − HPHᵀ)⁻¹R."""
    R = np.broadcast_to(R, (*R.shape[:2], P.shape[-1]))
    S = product(divide(R, R - sandwich(H, P)), R)
    return (S + S.transpose(1, 0, 2)) / 2


def _step(fit: Fit, P: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The Gauss-Newton step (batch, nx) of the window's first state, with x̄ so far ahead of it, and
    the covariance (nx, nx, batch) of where it leads, (P̄⁻¹ + Λ)⁻¹ with Λ the information of the
    window; without P̄⁻¹, because P̄ may be singular: what is known stays."""
    L = cholesky(P, semidefinite=True)
    L_transposed = L.transpose(1, 0, 2)
    inner = identity(len(P), P.shape[-1]) + product(product(L_transposed, fit.information), L)
    P = product(divide(L, inner), L_transposed)
    right = fit.right - np.einsum("ijb,bj->ib", fit.information, ahead)
    return ahead + np.einsum("ijb,jb->bi", P, right), P
