"""Moving-horizon estimation."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pinnobs_gym.estimation.estimator import Estimator, Range, State
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked
from pinnobs_gym.estimation.kalman import joseph_update, observe, predict
from pinnobs_gym.estimation.least_squares import Fit, linearised, root
from pinnobs_gym.estimation.moving_window import MovingWindow
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.estimation.square_root import carried, covariance, prior_root
from pinnobs_gym.simulation.matrices import cholesky, divide, identity, mapped, product, sandwich
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class WindowMemory:
    """The window, and the prior of its first state, from which all others follow. The batch is the
    last axis of matrices."""

    arrival: np.ndarray
    """x̄, the estimate of the window's first state from all samples before the window, shape
    (batch, nx)."""
    P: np.ndarray
    """P̄, the covariance of x̄, shape (nx, nx, batch)."""
    start: np.ndarray
    """The current estimate of the window's first state, shape (batch, nx)."""
    t: tuple[float, ...] = ()
    """Times of the window's samples in s."""
    y: tuple[np.ndarray, ...] = ()
    """Outputs at these samples, shape (batch, ny) each."""
    u: tuple[np.ndarray, ...] = ()
    """Inputs at these samples, shape (batch, nu) each."""


@dataclass(frozen=True)
class MHEMemory:
    """The windows."""

    first: WindowMemory | None
    """Windows whose states follow from their first one; None if the plant has process noise."""
    whole: MovingWindow | None
    """Windows of which all states are unknown, of some rows; None if there are none."""
    rows: np.ndarray
    """Numbers of these rows."""


@dataclass(frozen=True)
class MHE(Estimator, GaussianEstimator):
    """Moving-horizon estimation (Rao, Rawlings & Mayne 2003): the states that best fit the model and
    the outputs in a window of the latest samples, and the estimate from the samples before.

    For a plant with process noise, all states of the window are unknown. At each sample, starting
    from the result at the previous one, Gauss-Newton steps decrease the sum of (x − x̄)ᵀP̄⁻¹(x − x̄)
    over the window's first state x, of (y − h)ᵀR⁻¹(y − h) over the samples, and of wᵀQ⁻¹w over the
    steps, where w are the model's defects. A step is a Kalman smoother linearised about the current
    states (Bell 1994; `pinnobs_gym.estimation.linear_window`). When a sample leaves the window, x̄
    and P̄ are updated with it as in an extended Kalman filter linearised about x (Kühl et al. 2011).

    For a plant that is told to have none, the model is assumed exact within the window, and only
    the first state is unknown. `assumed_noise` is then added to P̄ when the window moves. Episodes
    with a very wide prior are computed with roots, see `pinnobs_gym.estimation.square_root`.

    A window longer than the record gives full-information estimation. Bounds of states hold for all
    states of the window or, with an exact model, for the first and the latest (the minimum within
    the box, see `pinnobs_gym.estimation.projection`).

    Default tuning is the same rule for all systems: P₀ is that of the prior, and the noise is
    the known one with `assumed_noise` added.
    """

    assumed_noise: float = 6e-4
    """As in `GaussianEstimator`."""
    window: int = 10
    """Number of samples in the window."""
    steps: int = 1
    """Gauss-Newton steps per sample; one is the real-time iteration of Diehl et al. 2005."""

    name = "mhe"
    equations = r"""
\text{exact model: } x_{k-N+1} &= \arg\min_x \; (x - \bar x)^\top \bar P^{-1} (x - \bar x)
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
        P0, mean, rows = prior.cov.transpose(1, 2, 0), prior.mean, np.arange(len(prior.mean))
        first = WindowMemory(mean, P0, mean)
        if self.noise.told.stochastic:
            roots = root(P0).transpose(2, 0, 1)
            return State(mean, P=prior.cov, memory=MHEMemory(None, self._whole(mean, roots), rows))
        L = prior_root(self.system, prior, self.noise.R(0.0))
        if L is None:
            return State(mean, P=prior.cov, memory=MHEMemory(first, None, rows[:0]))
        rows = carried(L)
        memory = MHEMemory(first, self._whole(mean[rows], L[rows]), rows)
        return State(mean, P=prior.cov, memory=memory)

    def _whole(self, mean: np.ndarray, roots: np.ndarray) -> MovingWindow:
        box = self.system.state_box
        inside = mean if box is None else nearest(mean, covariance(roots), box)
        return MovingWindow(mean, roots, inside[None])

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: MHEMemory = state.memory
        if memory.first is None:
            return self._by_all_states(memory, t, y, u)
        after = self._by_first_state(memory.first, t, y, u)
        if memory.whole is None:
            return replace(after, memory=replace(memory, first=after.memory))
        # Rows with a wide prior: their estimates are those with roots.
        rows = memory.rows
        wide = self._by_all_states(memory, t, y[rows], u[rows])
        values = {}
        for name in ("xhat", "P", "innovation", "S"):
            values[name] = getattr(after, name).copy()
            values[name][rows] = getattr(wide, name)
        return replace(after, **values, memory=replace(wide.memory, first=after.memory))

    def _by_all_states(self, memory: MHEMemory, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after a sample if all states of the window are unknown."""
        assert memory.whole is not None
        system, noise = self.system, self.noise
        window = memory.whole.extended(system, t, y, u)
        if len(window.t) > self.window:
            window = window.shortened(system, noise)
        innovation, H = observe(system, t, window.x[-1], y, u)
        for k in range(self.steps):
            window, states = window.improved(system, noise, not noise.told.stochastic)
            if k == 0:
                P_before = covariance(states.predicted_root[-1])
        H = H.transpose(2, 0, 1)
        S = H @ P_before @ H.swapaxes(1, 2) + noise.R(t, y).transpose(2, 0, 1)
        P = covariance(states.root[-1])
        memory = replace(memory, whole=window)
        return State(window.x[-1], t, u, P, innovation, S, memory)

    def _by_first_state(
        self, memory: WindowMemory, t: float, y: np.ndarray, u: np.ndarray
    ) -> State:
        """Return the state after a sample if the window's states follow from the first one, with
        the memory of these windows alone."""
        if len(memory.t) == self.window:
            memory = self._moved(memory, t, u)
        memory = replace(memory, t=(*memory.t, t), y=(*memory.y, y), u=(*memory.u, u))
        start = memory.start
        fit = self._fit(memory, start)
        # The trajectory from the previous first state ends at the prediction of this sample.
        innovation, H = observe(self.system, t, fit.x[-1], y, u)
        step, P = self._step(fit, memory, start)
        for _ in range(self.steps - 1):
            start = start + step
            fit = self._fit(memory, start)
            step, P = self._step(fit, memory, start)
        # Map the last step to the latest sample to first order, without a new trajectory.
        start = start + step
        xhat = fit.x[-1] + mapped(fit.X[-1], step)
        P = sandwich(fit.X[-1], P)
        memory = replace(memory, start=start)
        S = _innovation_covariance(P, H, self.noise.R(t, y)).transpose(2, 0, 1)
        P = ((P + P.transpose(1, 0, 2)) / 2).transpose(2, 0, 1)
        return State(xhat, t, u, P, innovation, S, memory)

    def _step(
        self, fit: Fit, memory: WindowMemory, start: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the step (batch, nx) of the window's first state, within its bounds, and the
        covariance (nx, nx, batch) of the result."""
        step, P = _step(fit, memory.P, memory.arrival - start)
        box = self.system.state_box
        if box is not None:
            step = nearest(start + step, P.transpose(2, 0, 1), box) - start
        return step, P

    def _fit(self, memory: WindowMemory, start: np.ndarray) -> Fit:
        """Return the model's trajectory through the window from its first state, and the normal
        equations of the outputs about it."""
        nx, batch = self.system.nx, len(start)
        X = identity(nx, batch)
        return linearised(self.system, self.noise, memory.t, memory.y, memory.u, start, X)

    def _moved(self, memory: WindowMemory, t: float, u: np.ndarray) -> WindowMemory:
        """Return the memory without the window's first sample, with which x̄ and P̄ are updated. The
        arguments t and u are those of the sample to be added."""
        start = memory.start
        innovation, H = observe(self.system, memory.t[0], start, memory.y[0], memory.u[0])
        # Update x̄ − x and P̄ with the sample, with the output linearised about x.
        offset = memory.arrival - start
        innovation = innovation - mapped(H, offset)
        R = self.noise.R(memory.t[0], memory.y[0])
        offset, P, _ = joseph_update(offset, memory.P, innovation, H, R)
        # Predict x, x̄ and P̄ to the next sample, which becomes the first of the window.
        second, u_second = (*memory.t, t)[1], (*memory.u, u)[1]
        times, inputs = (memory.t[0], second), (memory.u[0], u_second)
        start, P, F, _ = predict(self.system, times, start, P, self.noise, inputs)
        arrival = start + mapped(F, offset)
        memory = replace(memory, t=memory.t[1:], y=memory.y[1:], u=memory.u[1:])
        return replace(memory, arrival=arrival, P=P, start=start)


def _innovation_covariance(P: np.ndarray, H: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return S = HP⁻Hᵀ + R, shape (ny, ny, batch), computed as R(R − HPHᵀ)⁻¹R from the covariance P
    after the update."""
    R = np.broadcast_to(R, (*R.shape[:2], P.shape[-1]))
    S = product(divide(R, R - sandwich(H, P)), R)
    return (S + S.transpose(1, 0, 2)) / 2


def _step(fit: Fit, P: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the Gauss-Newton step (batch, nx) of the window's first state x, and the covariance
    (P̄⁻¹ + Λ)⁻¹ (nx, nx, batch) of the result.

    P̄ may be singular, so its inverse is avoided; components with zero variance in P̄ then follow x̄.

    Args:
        fit: the fit at x; Λ is its information.
        P: P̄, shape (nx, nx, batch).
        offset: x̄ − x, shape (batch, nx).
    """
    # With P̄ = LLᵀ, (P̄⁻¹ + Λ)⁻¹ = L(I + LᵀΛL)⁻¹Lᵀ.
    L = cholesky(P, semidefinite=True)
    L_transposed = L.transpose(1, 0, 2)
    inner = identity(len(P), P.shape[-1]) + product(product(L_transposed, fit.information), L)
    P = product(divide(L, inner), L_transposed)
    # The step is that to x̄ plus the correction by the outputs from there.
    right = fit.right.T - mapped(fit.information, offset)
    return offset + mapped(P, right), P
