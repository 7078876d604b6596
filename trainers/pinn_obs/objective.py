"""The loss of PINN-Obs and its gradient in NumPy, written out by hand.

At a thousand points and twenty neurons torch spends its time on overhead; the same sums in NumPy,
with the time derivative carried forward through the layers and one reverse pass, take a fraction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.network import Architecture
from pinnobs_gym.system import System


def _tanh(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    value = np.tanh(z)
    slope = 1 - value * value
    return value, slope, -2 * value * slope


def _sine(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    value = np.sin(z)
    return value, np.cos(z), -value


def _sigmoid(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    value = 0.5 + 0.5 * np.tanh(0.5 * z)
    slope = value * (1 - value)
    return value, slope, slope * (1 - 2 * value)


def _relu(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    slope = (z > 0).astype(float)
    return z * slope, slope, np.zeros_like(z)


_ACTIVATIONS: dict[str, Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]] = {
    "tanh": _tanh,
    "sine": _sine,
    "sigmoid": _sigmoid,
    "relu": _relu,
}
"""Each activation with its first and second derivative."""


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
    a sum of 1 over the points."""
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
    summed over components, with the points' quadrature for means: the terms are those of
    `trainers.pinn_obs.loss_terms` (equations (7), (8) and (9) of the paper). To them come the
    weighted squares of x̂ and L less those of the lead.

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
        lead: Lead,
    ) -> None:
        self.system, self.points, self.weights, self.lead = system, points, weights, lead
        self.nx, self.ny = system.nx, system.ny
        self._shapes = architecture.shapes
        self._activation = _ACTIVATIONS[architecture.activation]
        value, rate = architecture.features(points.t)
        self._inputs = np.concatenate([value.T, rate.T], axis=1)
        scale = architecture.scale or (1.0,) * architecture.shapes[-1][0]
        self._scale = np.asarray(scale)[:, None]

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray]:
        """The loss at weights theta (n,) and its gradient (n,)."""
        with np.errstate(all="ignore"):  # a trial step too long is told by a loss not finite
            layers = list(self._layers(theta))
            xhat, rate, L, tape = self._forward(layers)
            loss, *by_output = self._terms(xhat, rate, L)
            return loss, self._reverse(layers, tape, *by_output)

    def terms(self, theta: np.ndarray) -> np.ndarray:
        """The paper's three terms (3,) at weights theta (n,), in the system's own units."""
        xhat, rate, L, _ = self._forward(list(self._layers(theta)))
        points, ones = self.points, np.ones(self.nx)
        innovation, residual = self._defects(xhat, rate, L)
        initial = xhat[0] - points.xhat0
        return np.array(
            [
                initial @ initial,
                points.equation @ (residual * residual) @ ones,
                (points.output * innovation * innovation).sum(),
            ]
        )

    def _layers(self, theta: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Weights (out, in) and biases (out,) of each layer."""
        place = 0
        for out, fan_in in self._shapes:
            size = out * fan_in
            yield theta[place : place + size].reshape(out, fan_in), theta[place + size :][:out]
            place += size + out

    def _forward(self, layers: list) -> tuple[np.ndarray, np.ndarray, np.ndarray, list]:
        """x̂ and dx̂/dt (num_points, nx), L (num_points, nx, ny), and what the reverse pass needs.

        Values and time derivatives lie side by side, (neurons, 2 · num_points).
        """
        a, n, tape = self._inputs, len(self.points.t), []
        for W, b in layers[:-1]:
            z = W @ a
            value, slope, curvature = self._activation(z[:, :n] + b[:, None])
            tape.append((a, z[:, n:], slope, curvature))
            a = np.concatenate([value, slope * z[:, n:]], axis=1)
        W, b = layers[-1]
        tape.append((a, None, None, None))
        out = (W @ a[:, :n] + b[:, None]) * self._scale
        rate = (W[: self.nx] @ a[:, n:]) * self._scale[: self.nx]
        return out[: self.nx].T, rate.T, out[self.nx :].T.reshape(n, self.nx, self.ny), tape

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
    ) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        """The loss, and its derivatives by x̂, by dx̂/dt and by L."""
        points, weights, system, lead = self.points, self.weights, self.system, self.lead
        innovation, residual = self._defects(xhat, rate, L)
        initial = xhat[0] - points.xhat0
        by_rate = 2 * points.equation[:, None] * weights.equation * residual
        by_innovation = 2 * points.output * weights.output * innovation
        by_L = 2 * lead.by_L * (L - lead.L)
        by_xhat = 2 * lead.by_xhat * (xhat - lead.xhat)
        loss = float(weights.initial @ (initial * initial)) + 0.5 * float(
            (by_rate * residual).sum()
            + (by_innovation * innovation).sum()
            + (by_L * (L - lead.L)).sum()
            + (by_xhat * (xhat - lead.xhat)).sum()
        )
        by_innovation -= np.einsum("ki,kij->kj", by_rate, L)
        by_L -= by_rate[:, :, None] * innovation[:, None, :]
        H = system.h_jacobian(xhat)
        A = system.f_jacobian(points.t, xhat, points.u)
        by_xhat -= np.einsum("ki,kij->kj", by_rate, A)
        by_xhat -= np.einsum("ki,kij->kj", by_innovation * points.there, H)
        by_xhat[0] += 2 * weights.initial * initial
        return loss, by_xhat, by_rate, by_L

    def _reverse(
        self,
        layers: list,
        tape: list,
        by_xhat: np.ndarray,
        by_rate: np.ndarray,
        by_L: np.ndarray,
    ) -> np.ndarray:
        """The gradient (n,) from the derivatives by the network's outputs."""
        n, nx = len(self.points.t), self.nx
        by_z = np.zeros((len(self._scale), 2 * n), by_xhat.dtype)
        by_z[:nx, :n], by_z[nx:, :n] = by_xhat.T, by_L.reshape(n, -1).T
        by_z[:nx, n:] = by_rate.T
        by_z *= self._scale
        parts: list[np.ndarray] = []
        for (W, _), below, here in zip(layers[:0:-1], tape[:0:-1], tape[-2::-1], strict=True):
            parts[:0] = [(by_z @ below[0].T).ravel(), by_z[:, :n].sum(1)]
            by_a = W.T @ by_z
            _, z_rate, slope, curvature = here
            by_z = np.empty_like(by_a)
            by_z[:, n:] = by_a[:, n:] * slope
            by_z[:, :n] = by_a[:, :n] * slope + by_a[:, n:] * z_rate * curvature
        parts[:0] = [(by_z @ tape[0][0].T).ravel(), by_z[:, :n].sum(1)]
        return np.concatenate(parts)
