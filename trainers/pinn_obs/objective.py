"""The loss of PINN-Obs and its gradient, derived by hand, in NumPy or torch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from array_api_compat import array_namespace

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.simulation.system import Array, System
from trainers.pinn_obs.passes import Passes, inputs_of


@dataclass(frozen=True, eq=False)
class Points:
    """The points at which the loss is taken, and their weights; the first is t₀."""

    t: np.ndarray
    """Times in s, shape (num_points,)."""
    u: np.ndarray
    """Inputs, shape (num_points, nu)."""
    y: np.ndarray
    """Outputs, shape (num_points, ny); zero for a missing output."""
    present: np.ndarray
    """1.0 for an output that is present, 0.0 for a missing one, shape (num_points, ny)."""
    equation: np.ndarray
    """Quadrature weights of the equation's residuals, shape (num_points,); their sum is 1."""
    output: np.ndarray
    """Quadrature weights of the outputs, shape (num_points, ny); zero for a missing output. Their
    sum is ny, or less if an output is missing throughout."""
    xhat0: np.ndarray
    """Initial estimate at t₀, shape (nx,)."""


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the terms of the loss, component by component."""

    initial: np.ndarray
    """Weights of the squared errors of x̂(t₀), shape (nx,)."""
    equation: np.ndarray
    """Weights of the squared residuals of the equations, shape (nx,)."""
    output: np.ndarray
    """Weights of the squared innovations, shape (ny,)."""


@dataclass(frozen=True, eq=False)
class Lead:
    """Penalty on the estimates and gains that is added to the paper's loss."""

    xhat: np.ndarray
    """Target of the estimates, shape (num_points, nx)."""
    by_xhat: np.ndarray
    """Weights of the squared deviations of the estimates, shape (num_points, nx)."""
    L: np.ndarray
    """Target of the gains, shape (num_points, nx, ny)."""
    by_L: np.ndarray
    """Weights of the squared deviations of the gains, shape (num_points, nx, ny)."""


class Objective:
    """The weighted loss as a function of all weights of a network in one vector.

    It is w₀·(x̂(t₀) − x̂₀)² + w_ode·mean (dx̂/dt − f − L(y − h))² + w_y·mean (h − y)² with f and h at
    (t, x̂, u), summed over components; means are by the points' quadrature. These are the paper's
    terms:

    - MSE₀ = ‖x̂(t₀) − x̂₀‖². Equation (7) writes the norm without the square. The square is taken
      because the paper calls it a mean squared error, and because the gradient of a norm has length
      one even for small errors, so that a constant step would not converge to x̂₀.
    - MSE_g = mean ‖dx̂/dt − f(t, x̂, u) − L(t)(y − h(t, x̂, u))‖², equations (e55) and (8), with
      h(t, x̂, u) for the paper's Cx̂.
    - MSE_y = mean ‖h(t, x̂, u) − y‖², equation (9).

    The innovation of a missing output is zero. With a ``lead``, the weighted squared deviations of
    x̂ and L from its targets are added. All is computed in the network's precision.

    Args:
        architecture: architecture of the network.
        system: the model.
        points: the points at which the loss is taken.
        weights: weights of the terms.
        lead: penalty on x̂ and L.
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
        scale = architecture.scale or (1.0,) * architecture.shapes[-1][0]
        parts = {f.name: getattr(points, f.name) for f in fields(points)}
        if lead is not None:
            parts |= {f"lead_{f.name}": getattr(lead, f.name) for f in fields(lead)}
        parts["w_initial"] = weights.initial
        parts["w_equation"] = points.equation[:, None] * weights.equation
        parts["w_output"] = points.output * weights.output
        parts["scale"], parts["inputs"] = np.asarray(scale), inputs_of(architecture, points.t)
        laid_out = {name: _inner(np.asarray(part, dtype)) for name, part in parts.items()}
        self._set(architecture, system, laid_out)

    def _set(self, architecture: Architecture, system: System, parts: dict[str, Array]) -> None:
        self.architecture, self.system, self._parts = architecture, system, parts
        lead = {n.removeprefix("lead_"): part for n, part in parts.items() if n.startswith("lead_")}
        self.points = Points(*(parts[f.name] for f in fields(Points)))
        self.lead = Lead(**lead) if lead else None
        self._initial, self._equation = parts["w_initial"], parts["w_equation"]
        self._output = parts["w_output"]
        self._passes = Passes(architecture, parts["inputs"], parts["scale"])

    @classmethod
    def stacked(cls, objectives: Sequence[Objective], device: str) -> Objective:
        """Combine objectives of networks of one shape, with equally many points, in torch.

        The first axis of the arguments and results of `values` is then the batch. On a CPU this is
        slower than one objective after another, since the batch does not fit into the cache.
        """
        whole, first = cls.__new__(cls), objectives[0]
        names = first._parts
        stacks = {n: np.stack([objective._parts[n] for objective in objectives]) for n in names}
        tensors = {n: torch.as_tensor(stack, device=device) for n, stack in stacks.items()}
        whole._set(first.architecture, first.system, tensors)
        return whole

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the loss at weights theta (n,) and its gradient (n,)."""
        with np.errstate(all="ignore"):  # the loss of too long a trial step is not finite
            loss, gradient = self.values(theta)
        return float(loss), gradient

    def values(self, theta: Array) -> tuple[Array, Array]:
        """Return the losses (...) at weights theta (..., n) and their gradients (..., n)."""
        loss, *by_output = self._terms(*self._forward(theta))
        return loss, self._passes.reverse(*by_output)

    def terms(self, theta: np.ndarray) -> np.ndarray:
        """Return the paper's three terms (3,) at weights theta (n,), in the system's units."""
        with np.errstate(all="ignore"):
            points, (xhat, rate, L) = self.points, self._forward(theta)
            innovation, residual = self._defects(xhat, rate, L)
            equation = (points.equation[:, None] * residual * residual).sum()
            output = (points.output * innovation * innovation).sum()
        initial = xhat[0] - points.xhat0
        return np.array([initial @ initial, equation, output], dtype=float)

    def _forward(self, theta: Array) -> tuple[Array, Array, Array]:
        """Return x̂ and dx̂/dt (..., num_points, nx), and L (..., num_points, nx, ny)."""
        out, rate = self._passes.forward(theta)
        nx, ny = self.system.nx, self.system.ny
        L = out[..., nx:, :].mT
        return out[..., :nx, :].mT, rate.mT, L.reshape(*L.shape[:-1], nx, ny)

    def _defects(self, xhat: Array, rate: Array, L: Array) -> tuple[Array, Array]:
        """Return the innovations (..., num_points, ny), zero for missing outputs, and the residuals
        (..., num_points, nx)."""
        points = self.points
        outputs = self.system.h(points.t, xhat, points.u)
        innovation = self.system.output_residual(points.y, outputs) * points.present
        correction = (L * innovation[..., None, :]).sum(-1)
        return innovation, rate - self.system.f(points.t, xhat, points.u) - correction

    def _terms(self, xhat: Array, rate: Array, L: Array) -> tuple[Array, Array, Array]:
        """Return the losses (...), and their derivatives by the networks' outputs
        (..., nx + nx·ny, num_points) and by dx̂/dt (..., nx, num_points)."""
        # The loss, and half its derivatives by the initial error, residual and innovation.
        points, system = self.points, self.system
        innovation, residual = self._defects(xhat, rate, L)
        initial = xhat[..., 0, :] - points.xhat0
        by_initial, by_rate = self._initial * initial, self._equation * residual
        by_innovation = self._output * innovation
        loss = (by_initial * initial).sum(-1) + (by_rate * residual).sum((-2, -1))
        loss += (by_innovation * innovation).sum((-2, -1))
        # Chain rule: the residual depends on L, the innovation and x̂; the innovation on x̂.
        by_innovation -= _through(by_rate, L)
        by_innovation *= points.present
        by_L = by_rate[..., None] * -innovation[..., None, :]
        at = points.t, xhat, points.u
        A, H = system.f_jacobian(*at), system.h_jacobian(*at)
        by_xhat = _through(by_rate, -A) - _through(by_innovation, H)
        by_xhat[..., 0, :] += by_initial
        if (lead := self.lead) is not None:  # the penalty and half its derivatives
            for value, towards, weight, by, axes in (
                (xhat, lead.xhat, lead.by_xhat, by_xhat, (-2, -1)),
                (L, lead.L, lead.by_L, by_L, (-3, -2, -1)),
            ):
                departure = value - towards
                drawn = weight * departure
                loss += (drawn * departure).sum(axes)
                by += drawn
        # Both outputs of the network in one array, and the factor 2 of all derivatives.
        xp, flat = array_namespace(loss), by_L.reshape(*by_L.shape[:-2], -1)
        by_out = xp.concat([by_xhat.mT, flat.mT], axis=-2)
        by_out *= 2
        return loss, by_out, 2 * by_rate.mT


def _through(by: Array, J: Array) -> Array:
    """Multiply derivatives by a function's value (..., m) with its Jacobian J (..., m, n)."""
    out = by[..., :1] * J[..., 0, :]
    for i in range(1, J.shape[-2]):
        out += by[..., i : i + 1] * J[..., i, :]
    return out


def _inner(array: np.ndarray) -> np.ndarray:
    """Return a copy of an array (num_points, ...) with the points innermost in memory.

    Arithmetic on few components of many points is then contiguous.
    """
    return np.ascontiguousarray(array.T).T
