"""The common part of the sigma-point filters, which differ only in the choice of their points."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.gaussian import GaussianEstimator, checked, covariances
from pinnobs_gym.estimation.kalman import gain_of_deviations
from pinnobs_gym.estimation.outliers import OutlierLaw
from pinnobs_gym.estimation.point_images import SigmaPoints
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimation.square_root import (
    carried,
    compressed,
    covariance,
    gain,
    prior_root,
    root_of,
)
from pinnobs_gym.estimation.wrapping import say_what_turns, wrapped_state
from pinnobs_gym.simulation.matrices import factor, mapped, outer, product, sandwich
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.value_shape import outputs_at


@dataclass(frozen=True)
class SigmaPointMemory:
    """The filter's memory in addition to the fields of `State`. The batch is the last axis."""

    points: tuple[np.ndarray, np.ndarray, np.ndarray]
    """Points (num_points, nx), their weights in means (num_points, 1, 1), and the square roots of
    their weights in covariances (num_points, 1); see `SigmaPointFilter.points`."""
    jitter: np.ndarray
    """Largest relative amount added to the variances so far, shape (batch,); zero if none was."""


@dataclass(frozen=True)
class SigmaPointFilter(RecursiveEstimator, GaussianEstimator):
    """A Kalman filter that computes moments from points propagated through the model.

    New points are generated after the prediction, so that their spread includes Q, which is that
    along the trajectory of the estimate. With the
    weighted deviations X of the points and Y of their outputs, the gain is K = XYᵀ(YYᵀ + R)⁻¹ and
    the covariance P⁺ = (X − KY)(X − KY)ᵀ + KRKᵀ. This is Joseph's form, positive semidefinite for
    any K (Arasaratnam & Haykin 2009, the square-root form of section VII). If a covariance has no
    Cholesky factor, its variances are enlarged (`pinnobs_gym.simulation.matrices.JITTER`), and the
    relative amount is reported in the state's memory.

    Points outside of the states' bounds, and points at which f or h is not defined, are replaced as
    in `pinnobs_gym.estimation.point_images`. Of an angle, the points' values are taken within half
    a turn of that at x̂, so that their mean and deviations are those of numbers.
    """

    outliers: float | None = None
    """Probability that an output is an outlier, in which case its noise is `outlier_size` times as
    large; the gain is then the mean of the gains of both cases, weighted by their posterior
    probabilities (`pinnobs_gym.estimation.outliers.OutlierLaw`). No output counts as one if None.
    """
    outlier_size: float = 30.0
    """Standard deviation of outliers, in those of the output noise."""

    template = "sigma_points"
    exempt_from = {
        "model_alone": "its mean is that of points that the model has moved apart",
        "blank_rows": "it draws its points anew at every row",
    }
    equations = r"""
\chi_i^- &= \varphi(\hat x_{k-1} + \sqrt{P_{k-1}}\, \xi_i), \qquad
\hat x_k^- = \sum_i w_i \chi_i^- \\
P_k^- &= \sum_i v_i (\chi_i^- - \hat x_k^-)(\chi_i^- - \hat x_k^-)^\top + Q \\
\chi_i &= \hat x_k^- + \sqrt{P_k^-}\, \xi_i, \qquad \hat y = \sum_i w_i h(t_k, \chi_i, u_k) \\
X_i &= \sqrt{v_i} (\chi_i - \hat x_k^-), \qquad Y_i = \sqrt{v_i} (h(t_k, \chi_i, u_k) - \hat y) \\
\text{outliers: } & R_{jj} := R_{jj}\, r_j, \quad
\frac{1}{(Y Y^\top)_{jj} + r_j R_{jj}} = \frac{1 - \pi_j}{(Y Y^\top)_{jj} + R_{jj}}
+ \frac{\pi_j}{(Y Y^\top)_{jj} + \mathrm{size}^2 R_{jj}}, \quad
\pi_j = \text{P}(\text{outlier} \mid e_j) \\
K &= X Y^\top (Y Y^\top + R)^{-1} \\
\hat x_k &= \hat x_k^- + K\, (y_k - \hat y) \\
P_k &= (X - K Y)(X - K Y)^\top + K R K^\top
"""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.outliers is not None:
            OutlierLaw(self.outliers, self.outlier_size)  # raises for values out of range

    @abstractmethod
    def points(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the points for the standard normal distribution, (num_points, nx), and their
        weights in means and in covariances, (num_points,) each. No weight is negative."""

    def not_compiled(self) -> str:
        count, most = len(self.points()[0]), 2 * self.system.nx + 1
        return f"it has {count} points, more than {most}" if count > most else ""

    def plan_settings(self) -> dict[str, Any]:
        points, mean_weights, cov_weights = self.points()
        settings = {"points": points, "weights": mean_weights, "roots": np.sqrt(cov_weights)}
        settings |= {"outlier_rate": self.outliers or 0.0, "outlier_size": self.outlier_size}
        return settings | {"num_points": len(points)}

    def memory_rows(self, memory: SigmaPointMemory, rows: np.ndarray) -> SigmaPointMemory:
        return replace(memory, jitter=memory.jitter[rows])

    def with_memory_rows(
        self, memory: SigmaPointMemory, rows: np.ndarray, part: SigmaPointMemory
    ) -> SigmaPointMemory:
        jitter = memory.jitter.copy()
        jitter[rows] = part.jitter
        return replace(memory, jitter=jitter)

    def reset(self, prior: Prior) -> State:
        prior = checked(prior)
        batch = len(prior.mean)
        unit, mean_weights, cov_weights = self.points()
        points = unit, mean_weights[:, None, None], np.sqrt(cov_weights)[:, None]
        memory = SigmaPointMemory(points, np.zeros(batch))
        root = prior_root(self.system, prior, self.noise.R(0.0))
        state = State(prior.mean, P=prior.cov, memory=memory, root=root)
        return wrapped_state(self.system, state)

    def predict(self, state: State, t: float, u: np.ndarray) -> State:
        assert state.t is not None
        memory: SigmaPointMemory = state.memory
        unit, mean_weights, roots = memory.points
        L, memory = _factor(state, memory)
        times, inputs, box = (state.t, t), (state.u, u), self.system.state_box
        sigma = SigmaPoints.of(state.xhat, unit @ L, box, state.P)
        # Propagate the estimate and each point through the model; then compute mean and covariance.
        whole = np.concatenate([state.xhat[None], sigma.used])
        values, F, Q = model_step_moments(self.system, self.noise, *times, whole, *inputs)
        step = partial(_step, self.system, times, inputs)
        points = sigma.images(values[1:], step, lambda: F, partial(self._notice, "f"))
        points = nearest(points, values[0], self.system.state_period)
        points = np.ascontiguousarray(points.transpose(2, 0, 1))
        mean = product(points, mean_weights)[:, 0]  # (nx, batch)
        X = (points - mean[:, None]) * roots
        P = (outer(X, X) + Q).transpose(2, 0, 1)
        after = State(mean.T, state.t, state.u, P, state.innovation, None, memory, state.root)
        if state.root is not None:
            after = _rooted(after, X, root_of(Q.transpose(2, 0, 1)))
        return wrapped_state(self.system, after)

    def correct(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State:
        memory: SigmaPointMemory = state.memory
        unit, mean_weights, roots = memory.points
        xhat, R = state.xhat, self.noise.R(t, y)
        say_what_turns(self.label, self.system, (t, y, u), xhat, covariances(state), R)
        L, memory = _factor(state, memory)
        # New points about the prediction, whose spread includes Q, and their outputs.
        X = unit @ L  # (nx, num_points, batch)
        sigma = SigmaPoints.of(xhat, X, self.system.state_box, state.P)
        output = partial(_output, self.system, t, u)

        def jacobian() -> np.ndarray:
            return self.system.h_jacobian(t, xhat, u).transpose(1, 2, 0)

        outputs = sigma.images(output(sigma.used), output, jacobian, partial(self._notice, "h"))
        outputs = sigma.unwound(outputs, output, jacobian, self.system.output_period)
        outputs = outputs.transpose(2, 0, 1)
        mean = product(outputs, mean_weights)[:, 0]
        X, Y = X * roots, (outputs - mean[:, None]) * roots
        innovation, missing = self.system.output_residual(y, mean.T), np.isnan(y)
        if np.count_nonzero(missing):
            innovation = np.where(missing, 0.0, innovation)
            Y = np.where(missing.T[:, None], 0.0, Y)
        if self.outliers is None:
            K, S = gain_of_deviations(X, Y, R)
        else:  # the sample is used with a larger R, and S is that of a usual one
            law, S = OutlierLaw(self.outliers, self.outlier_size), outer(Y, Y) + R
            R = law.inflated(innovation.T, S, R)
            K, _ = gain_of_deviations(X, Y, R)
        if state.root is not None:
            rows, noise = carried(state.root), np.broadcast_to(R, (*R.shape[:2], len(y)))
            parts = (part.transpose(2, 0, 1)[rows] for part in (X, Y, noise))
            K[..., rows] = gain(*parts).transpose(1, 2, 0)
        # Covariance in Joseph's form, (X − KY)(X − KY)ᵀ + KRKᵀ.
        X -= product(K, Y)
        P = outer(X, X)
        P += sandwich(K, R)
        xhat = (xhat.T + mapped(K, innovation).T).T
        P, S = ((P + P.transpose(1, 0, 2)) / 2).transpose(2, 0, 1), S.transpose(2, 0, 1)
        after = State(xhat, t, u, P, innovation, S, memory, state.root)
        if state.root is None:
            return after
        noise = K.transpose(2, 0, 1) @ root_of(R.transpose(2, 0, 1))
        return _rooted(after, X, noise)

    def _notice(self, function: str) -> str:
        """Return what the log says where f or h is not defined at all points."""
        return (
            f"{self.label} on {type(self.system).__name__}: {function} is not defined at all sigma "
            "points; they are moved towards the estimate"
        )


def _step(
    system: System,
    times: tuple[float, float],
    inputs: tuple[np.ndarray | None, np.ndarray],
    x: np.ndarray,
) -> np.ndarray:
    """Return `model_step` of states x (..., nx) between two times."""
    return model_step(system, *times, x, *inputs)


def _output(system: System, t: float, u: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return the outputs (..., ny) at states x (..., nx)."""
    return outputs_at(system, t, x, u)


def _factor(state: State, memory: SigmaPointMemory) -> tuple[np.ndarray, SigmaPointMemory]:
    """Return roots of the state's covariances (nx, nx, batch): those that it has, and Cholesky
    factors otherwise. Also return the memory with the updated jitter."""
    L, jitter = factor(covariances(state), memory.jitter)
    if state.root is not None:
        rows = carried(state.root)
        L[..., rows], jitter = state.root[rows].transpose(1, 2, 0), jitter.copy()
        jitter[rows] = memory.jitter[rows]
    return L, memory if jitter is memory.jitter else replace(memory, jitter=jitter)


def _rooted(state: State, X: np.ndarray, noise: np.ndarray) -> State:
    """Return the state with new roots in the rows that have them, from weighted deviations X (nx,
    num_points, batch) and roots of what noise adds (batch, nx, m)."""
    assert state.root is not None
    assert state.P is not None
    rows = carried(state.root)
    root, P = state.root.copy(), state.P.copy()
    noise = np.broadcast_to(noise, (len(root), *noise.shape[1:]))
    root[rows] = compressed(X.transpose(2, 0, 1)[rows], noise[rows])
    P[rows] = covariance(root[rows])
    return replace(state, root=root, P=P)
