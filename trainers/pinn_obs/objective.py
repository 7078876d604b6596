"""The loss of PINN-Obs and its gradient in NumPy, written out by hand."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import numpy as np

from pinnobs_gym.network import Architecture
from pinnobs_gym.system import System
from trainers.pinn_obs.passes import Passes


@dataclass(frozen=True, eq=False)
class Points:
    """Where the loss looks, and with which weights; the first is t₀."""

    t: np.ndarray
    """Times in s, shape (num_points,)."""
    u: np.ndarray
    """Inputs there, shape (num_points, nu)."""
    y: np.ndarray
    """Outputs there, shape (num_points, ny); zero where they are missing."""
    there: np.ndarray
    """1.0 where an output is there, 0.0 where it is missing, shape (num_points, ny)."""
    equation: np.ndarray
    """Quadrature weights of the equation's residuals, shape (num_points,); their sum is 1."""
    output: np.ndarray
    """Quadrature weights of the outputs, shape (num_points, ny); zero where they are missing, with
    a sum of ny over all."""
    xhat0: np.ndarray
    """Initial estimate at t₀, shape (nx,)."""


@dataclass(frozen=True, eq=False)
class Weights:
    """What the terms of the loss are multiplied by, component by component."""

    initial: np.ndarray
    """Of the squared errors of x̂(t₀), shape (nx,)."""
    equation: np.ndarray
    """Of the squared residuals of the equations, shape (nx,)."""
    output: np.ndarray
    """Of the squared innovations, shape (ny,)."""


@dataclass(frozen=True, eq=False)
class Lead:
    """What the network is drawn towards beside the paper's loss, and how strongly."""

    xhat: np.ndarray
    """Estimates, shape (num_points, nx)."""
    by_xhat: np.ndarray
    """Weights of the squared departures from them, shape (num_points, nx)."""
    L: np.ndarray
    """Gains, shape (num_points, nx, ny)."""
    by_L: np.ndarray
    """Weights of the squared departures from them, shape (num_points, nx, ny)."""


class Objective:
    """The weighted loss as a function of all weights of a network in one vector.

    w₀·(x̂(t₀) − x̂₀)² + w_ode·mean (dx̂/dt − f(t, x̂, u) − L(y − h(x̂)))² + w_y·mean (h(x̂) − y)²
    summed over components, with the points' quadrature for means. These are the paper's terms:

    - MSE₀ = ‖x̂(t₀) − x̂₀‖². Equation (7) writes the norm without the square. The square is taken
      because the paper names it a mean squared error, and because a bare norm has a gradient of
      length one however small the error, so that a constant step never settles on x̂₀.
    - MSE_g = mean ‖dx̂/dt − f(t, x̂, u) − L(t)(y − h(x̂))‖², equations (e55) and (8), with h(x̂) for
      the paper's Cx̂.
    - MSE_y = mean ‖h(x̂) − y‖², equation (9).

    A missing output counts as a zero innovation. To them come the weighted squares of x̂ and L less
    those of the lead, if there is one. Everything is computed in the network's precision.

    Args:
        architecture: the network's.
        system: the model.
        points: where the loss looks.
        weights: of the terms.
        lead: what x̂ and L are drawn towards.
    """

    def __init__(
        self,
        architecture: Architecture,
        system: System,
        points: Points,
        weights: Weights,
        lead: Lead | None = None,
    ) -> None:
        dtype = np.dtype(architecture.dtype)
        self._passes, self.system = Passes(architecture, points.t), system
        self.points = _laid_out(points, dtype)
        self.lead = None if lead is None else _laid_out(lead, dtype)
        self._initial = _inner(weights.initial, dtype)
        self._equation = _inner(points.equation[:, None] * weights.equation, dtype)
        self._output = _inner(points.output * weights.output, dtype)

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """The loss at weights theta (n,) and its gradient (n,)."""
        with np.errstate(all="ignore"):  # a trial step too long is told by a loss not finite
            loss, *by_output = self._terms(*self._forward(theta))
            return loss, self._passes.reverse(*by_output)

    def terms(self, theta: np.ndarray) -> np.ndarray:
        """The paper's three terms (3,) at weights theta (n,), in the system's own units."""
        with np.errstate(all="ignore"):
            points, (xhat, rate, L) = self.points, self._forward(theta)
            innovation, residual = self._defects(xhat, rate, L)
            equation = (points.equation[:, None] * residual * residual).sum()
            output = (points.output * innovation * innovation).sum()
        initial = xhat[0] - points.xhat0
        return np.array([initial @ initial, equation, output], dtype=float)

    def _forward(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x̂ and dx̂/dt (num_points, nx), and L (num_points, nx, ny)."""
        out, rate = self._passes.forward(theta)
        nx, ny = self.system.nx, self.system.ny
        return out[:nx].T, rate.T, out[nx:].T.reshape(-1, nx, ny)

    def _defects(
        self, xhat: np.ndarray, rate: np.ndarray, L: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Innovations (num_points, ny), zero where missing, and residuals (num_points, nx)."""
        points = self.points
        innovation = (points.y - self.system.h(xhat)) * points.there
        correction = (L * innovation[:, None, :]).sum(-1)
        return innovation, rate - self.system.f(points.t, xhat, points.u) - correction

    def _terms(
        self, xhat: np.ndarray, rate: np.ndarray, L: np.ndarray
    ) -> tuple[float, np.ndarray, np.ndarray]:
        """The loss, and its derivatives by the network's outputs (nx + nx·ny, num_points) and by
        dx̂/dt (nx, num_points)."""
        points, system = self.points, self.system
        innovation, residual = self._defects(xhat, rate, L)
        initial = xhat[0] - points.xhat0
        by_initial, by_rate = self._initial * initial, self._equation * residual  # halves of them
        by_innovation = self._output * innovation
        loss = (by_initial * initial).sum() + (by_rate * residual).sum()
        loss += (by_innovation * innovation).sum()
        by_innovation -= _through(by_rate, L)
        by_innovation *= points.there
        by_L = by_rate[:, :, None] * -innovation[:, None, :]
        A, H = system.f_jacobian(points.t, xhat, points.u), system.h_jacobian(xhat)
        by_xhat = _through(by_rate, -A) - _through(by_innovation, H)
        by_xhat[0] += by_initial
        if (lead := self.lead) is not None:
            for value, towards, weight, by in (
                (xhat, lead.xhat, lead.by_xhat, by_xhat),
                (L, lead.L, lead.by_L, by_L),
            ):
                departure = value - towards
                drawn = weight * departure
                loss += (drawn * departure).sum()
                by += drawn
        by_out = np.concatenate([by_xhat.T, by_L.reshape(len(by_L), -1).T])
        by_out *= 2
        return float(loss), by_out, 2 * by_rate.T


def _through(by: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Derivatives by a function's value (num_points, m) taken through its Jacobian J
    (num_points, m, n) at every point."""
    out = by[:, :1] * J[:, 0]
    for i in range(1, J.shape[1]):
        out += by[:, i : i + 1] * J[:, i]
    return out


_Part = TypeVar("_Part", Points, Lead)


def _laid_out(part: _Part, dtype: np.dtype) -> _Part:
    return replace(part, **{f.name: _inner(getattr(part, f.name), dtype) for f in fields(part)})


def _inner(array: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """The same numbers (num_points, ...) in that precision, with the points innermost in memory, so
    that arithmetic on few components of many points is contiguous."""
    return np.ascontiguousarray(np.asarray(array, dtype).T).T
