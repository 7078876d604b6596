"""Moving-horizon estimation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from pinnobs_gym.estimation.compiled_window import CompiledWindow, compiled_window
from pinnobs_gym.estimation.estimator import Estimator, Range, State
from pinnobs_gym.estimation.exact_window import ExactWindow, innovation_covariance
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked, covariances
from pinnobs_gym.estimation.kalman import observe
from pinnobs_gym.estimation.least_squares import root
from pinnobs_gym.estimation.moving_window import MovingWindow
from pinnobs_gym.estimation.projection import nearest
from pinnobs_gym.estimation.square_root import carried, covariance, prior_root
from pinnobs_gym.estimation.window_samples import WindowSamples
from pinnobs_gym.estimation.wrapping import say_what_turns
from pinnobs_gym.simulation.matrices import mapped, sandwich
from pinnobs_gym.simulation.record import Prior


@dataclass(frozen=True)
class MHEMemory:
    """The windows."""

    exact: ExactWindow | None
    """Windows whose states follow from their first one; None if all states of all windows are
    unknown."""
    whole: MovingWindow | None
    """Windows of which all states are unknown: of all rows, or of those with a very wide prior if
    there are windows of the other kind; None if no row has one."""
    rows: np.ndarray
    """Numbers of the rows with a very wide prior, see `pinnobs_gym.estimation.square_root`."""


@dataclass(frozen=True)
class MHE(Estimator, GaussianEstimator):
    """Moving-horizon estimation (Rao, Rawlings & Mayne 2003): the states that best fit the model,
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

    When to choose it: where the states have bounds, or a filter that linearises once per sample
    goes astray, and a step may cost up to a hundred times that of `ekf`.
    """

    assumed_noise: float = 6e-4
    """Standard deviation of process noise that is assumed beyond the known one, over each state's
    scale and the benchmark's duration; with an exact model it is added when the window moves."""
    window: int = 10
    """Number of samples in the window."""
    steps: int = 1
    """Gauss-Newton steps per sample; one is the real-time iteration of Diehl et al. 2005."""

    name = "mhe"
    template: ClassVar[str] = "window"
    """The template of `pinnobs_gym.simulation.kernels` that computes the same."""
    exempt_from = {"blank_rows": "its window is a number of rows, and each of them takes a step"}
    equations = r"""
\text{process noise: } & x_{k-N+1}, \ldots, \hat x_k = \arg\min
\| x_{k-N+1} - \bar x \|^2_{\bar P^{-1}}
+ \sum_{j=k-N+1}^{k} \bigl\| y_j - h(t_j, x_j, u_j) \bigr\|^2_{R^{-1}}
+ \sum_{j=k-N+1}^{k-1} \bigl\| x_{j+1} - \varphi(x_j) \bigr\|^2_{Q_j^{-1}} \\
\text{exact model: } & x_{k-N+1} = \arg\min_x \| x - \bar x \|^2_{\bar P^{-1}}
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
        mean, P0, box = prior.mean, prior.cov, self.system.state_box
        start = mean if box is None else nearest(mean, P0, box)
        samples = WindowSamples.none(self.system, len(mean))
        stochastic, R = self.noise.told.stochastic, self.noise.R(0.0)
        roots, wide = prior_root(self.system, prior, R), None
        rows = np.arange(0) if roots is None else carried(roots)
        if len(rows):  # they enlarge rounding, and are to be the same in any process
            super().ask_model()
        # A noise of one's own that differs between rows is that of all rows, not of some.
        by_row = self.noise.samples is None and R.shape[-1] > 1
        if stochastic or (roots is not None and by_row):
            # Contiguous, so that sums are formed in one order in any batch.
            roots = np.ascontiguousarray(root(P0.transpose(1, 2, 0)).transpose(2, 0, 1))
            window = MovingWindow(mean, roots, start[None], not stochastic, samples)
            return State(mean, P=P0, memory=MHEMemory(None, window, rows))
        exact = ExactWindow(mean, P0.transpose(1, 2, 0), start, samples)
        if roots is not None:
            own = samples.rows(rows)
            wide = MovingWindow(mean[rows], roots[rows], start[None, rows], True, own)
        return State(mean, P=P0, memory=MHEMemory(exact, wide, rows))

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: MHEMemory = state.memory
        if state.t is None:
            sample, P = (t, y, u), covariances(state)
            say_what_turns(self.label, self.system, sample, state.xhat, P, self.noise.R(t))
        compiled = self.compiled
        after = None if compiled is None else compiled.update(state, t, y, u)
        if after is None:
            after = self.by_numpy(memory, t, y, u)
        if memory.exact is None or memory.whole is None:
            return after
        # Rows with a very wide prior: their estimates are those with roots.
        rows = memory.rows
        wide = self._by_all_states(memory, t, y[rows], u[rows])
        values = {}
        for name in ("xhat", "P", "innovation", "S"):
            values[name] = getattr(after, name).copy()
            values[name][rows] = getattr(wide, name)
        return replace(after, **values, memory=replace(after.memory, whole=wide.memory.whole))

    def by_numpy(self, memory: MHEMemory, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after a sample in NumPy, in rows without a wide prior if the states of
        windows follow from their first one; compiled code has to agree with it."""
        by = self._by_all_states if memory.exact is None else self._by_first_state
        return by(memory, t, y, u)

    def _by_all_states(self, memory: MHEMemory, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after a sample, in the rows of whose windows all states are unknown."""
        system, noise, window = self.system, self.noise, memory.whole
        assert window is not None
        if memory.exact is not None:
            noise = noise.rows(memory.rows)
        window = window.extended(system, t, y, u)
        if len(window.samples) > self.window:
            window = window.shortened(system, noise)
        # The last state is the prediction of this sample.
        innovation, H = observe(system, t, window.x[-1], y, u)
        window, states = window.improved(system, noise)
        H = H.transpose(2, 0, 1)
        S = H @ covariance(states.predicted_root[-1]) @ H.swapaxes(1, 2)
        S = S + noise.R(t, y).transpose(2, 0, 1)
        for _ in range(self.steps - 1):
            window, states = window.improved(system, noise)
        P = covariance(states.root[-1])
        return State(window.x[-1], t, u, P, innovation, S, replace(memory, whole=window))

    @cached_property
    def compiled(self) -> CompiledWindow | None:
        """The compiled code of the windows; None if they are computed in NumPy."""
        found = compiled_window(self)
        return None if isinstance(found, str) else found

    def ask_model(self) -> None:
        if self.compiled is None:  # compiled windows contain the model's steps
            super().ask_model()

    def _by_first_state(self, memory: MHEMemory, t: float, y: np.ndarray, u: np.ndarray) -> State:
        """Return the state after a sample, if the states of windows follow from their first one."""
        system, noise, window = self.system, self.noise, memory.exact
        assert window is not None
        window = window.extended(t, y, u)
        if len(window.samples) > self.window:
            window = window.shortened(system, noise)
        fit = window.fit(system, noise)
        # The trajectory from the previous first state ends at the prediction of this sample.
        innovation, H = observe(system, t, fit.x[-1], y, u)
        step, P = window.step(system, fit)
        for _ in range(self.steps - 1):
            window = replace(window, start=window.start + step)
            fit = window.fit(system, noise)
            step, P = window.step(system, fit)
        # Map the last step to the latest sample to first order, without a new trajectory.
        window = replace(window, start=window.start + step)
        xhat = fit.x[-1] + mapped(fit.X[-1], step)
        P = sandwich(fit.X[-1], P)
        S = innovation_covariance(P, H, noise.R(t, y)).transpose(2, 0, 1)
        P = ((P + P.transpose(1, 0, 2)) / 2).transpose(2, 0, 1)
        return State(xhat, t, u, P, innovation, S, replace(memory, exact=window))
