"""The posterior of a network's path: its squares, their Jacobian, and Laplace's approximation."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, solve_triangular

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.value_shape import outputs_at
from trainers.pinn_obs.points import inputs_at

PER_NEURON = 3
"""Points of the equation for each neuron of the estimates, so that no residual hides between."""
_CERTAIN = 1e-4
"""Standard deviation, over its scale, that the prior has at least, as one may be certain."""
_INDEPENDENT = 1e-8
"""Singular value, over the largest, from which on a combination of neurons counts."""


class PathPosterior:
    """Twice the negative logarithm of the posterior of a network's path x̂(t), up to a constant:

    ‖x̂(t₀) − x̂₀‖² over P₀ + ∫ ‖dx̂/dt − f(t, x̂, u)‖² over Q dt + Σ ‖y − h(t, x̂, u)‖² over R,

    where Q is the density of the process noise, the integral is taken by the trapezoidal rule at
    even points, and the sum over all samples (Jazwinski, "Stochastic Processes and Filtering
    Theory", 1970, section 5.3, there as the most probable trajectory). There is no gain in it.

    Only the output layer of the network is trained, so that x̂ is linear in what is trained: the
    hidden layer is that of a physics-informed extreme learning machine (Dwivedi & Srinivasan 2020).
    The variables are coefficients c (num, nx) of nearly orthogonal combinations of neurons, over
    the states' scales; `theta` and `coefficients` convert from and to the network's weights.

    Args:
        architecture: architecture of the network, with one hidden layer and no ``scale``.
        system: the model.
        record: record of one episode.
        noise: the noise, with process noise of every state and noise of every output.
        hidden: weights (width, num_features) and biases (width,) of the hidden layer.
        neurons: number of the first neurons, of which x̂ is made.
    """

    def __init__(
        self,
        architecture: Architecture,
        system: System,
        record: Record,
        noise: Noise,
        hidden: tuple[np.ndarray, np.ndarray],
        neurons: int,
    ) -> None:
        self.architecture, self.system, self.record = architecture, system, record
        self._hidden, self._neurons = hidden, neurons
        self._scale = vector(system.scale, system.nx, "scale")
        # Combinations of neurons whose values and rates are independent at the points.
        start, end = float(record.t[0]), float(record.t[-1])
        self._t = np.linspace(start, end, PER_NEURON * neurons + 1)
        values, rates = self.neurons(self._t)
        per_neuron = (end - start) / neurons
        _, size, rows = np.linalg.svd(np.vstack([values, per_neuron * rates]), full_matrices=False)
        kept = size > _INDEPENDENT * size[0]
        self._rows, self._size = rows[kept], size[kept]
        self._basis = (rows[kept] / size[kept, None]).T
        self._values, self._rates = values @ self._basis, rates @ self._basis
        self._at_samples = self.neurons(record.t)[0] @ self._basis
        # Weights of the three terms.
        prior = record.prior
        certain = np.diag((_CERTAIN * self._scale) ** 2)
        self._prior_root = _inverse_root(prior.cov[0] + certain)
        self._u = inputs_at(system, self._t, record)
        each = self._t[:1] if noise.constant else self._t
        self._density = np.stack([noise.root(float(t)).density[..., 0] for t in each])
        weights = np.full(len(self._t), (end - start) / (len(self._t) - 1))
        weights[[0, -1]] /= 2
        self._quadrature = np.sqrt(weights)
        y = record.y[0]
        self._present = ~np.isnan(y)
        R = [noise.R(float(t), y[k][None])[..., 0] for k, t in enumerate(record.t)]
        self._R_root = _inverse_root(np.stack(R)) * self._present[:, None, :]
        self._y = np.where(self._present, y, 0.0)

    @property
    def points(self) -> np.ndarray:
        """Times of the points of the equation in s, shape (num_points,)."""
        return self._t

    @property
    def num_outputs(self) -> int:
        """Number of outputs that are present, which the loss is on average at its minimum."""
        return int(self._present.sum())

    @property
    def least_noise(self) -> float:
        """The least standard deviation of the process noise over the states' scales, per √s."""
        std = np.sqrt(np.einsum("kii->ki", self._density))
        return float((std / self._scale).min())

    def neurons(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the values (num_times, neurons + 1) and the rates of the neurons of x̂ at times t
        (num_times,) in s; the last column is that of the bias."""
        W, b = (part[: self._neurons] for part in self._hidden)
        features, rates = self.architecture.features(t)
        value = np.tanh(features @ W.T + b)
        rate = (1 - value * value) * (rates @ W.T)
        one = np.ones((len(t), 1))
        return np.hstack([value, one]), np.hstack([rate, 0 * one])

    def coefficients(self, theta: np.ndarray) -> np.ndarray:
        """Return the coefficients (num, nx) of the weights theta (n,)."""
        last = self._output_layer(theta)[: self.system.nx]
        used = np.column_stack([last[:, : self._neurons], last[:, -1]])
        return (self._size * (used / self._scale[:, None] @ self._rows.T)).T

    def theta(self, coefficients: np.ndarray) -> np.ndarray:
        """Return the weights (n,) of coefficients (num, nx), with a gain of zero."""
        W, b = self._hidden
        used = (self._basis @ coefficients * self._scale).T
        size = self.architecture.shapes[-1][0] * (len(b) + 1)
        theta = np.concatenate([np.column_stack([W, b]).ravel(), np.zeros(size)])
        last = self._output_layer(theta)[: self.system.nx]
        last[:, : self._neurons], last[:, -1] = used[:, :-1], used[:, -1]
        return theta

    def _output_layer(self, theta: np.ndarray) -> np.ndarray:
        """Return a view (nx + nx·ny, width + 1) of the weights and biases of the last layer."""
        outputs, width = self.architecture.shapes[-1]
        return theta[-outputs * (width + 1) :].reshape(outputs, width + 1)

    def at_rest(self) -> np.ndarray:
        """Return the coefficients (num, nx) of a path that stays at the prior mean."""
        mean = np.zeros((len(self._rows[0]), self.system.nx))
        mean[-1] = self.record.prior.mean[0] / self._scale
        return self._size[:, None] * (self._rows @ mean)

    def terms(self, theta: np.ndarray) -> np.ndarray:
        """Return the three terms (3,) at weights theta (n,)."""
        return np.array([part @ part for part in self._residuals(self.coefficients(theta), 0.0)])

    def loss(self, coefficients: np.ndarray, added: float = 0.0) -> float:
        """Return the sum of squares at coefficients (num, nx).

        Args:
            coefficients: the coefficients.
            added: standard deviation of further process noise of every state, over its scale, in
                1/√s.
        """
        return float(sum(part @ part for part in self._residuals(coefficients, added)))

    def _residuals(self, coefficients: np.ndarray, added: float) -> Iterator[np.ndarray]:
        """Yield the residuals of each term in one vector, each over its standard deviation."""
        system, record = self.system, self.record
        with np.errstate(all="ignore"):  # a trial step may leave where the model is defined
            x, rate = (a @ coefficients * self._scale for a in (self._values, self._rates))
            start = system.state_residual(x[:1], record.prior.mean[:1])[0]
            yield self._prior_root @ start
            defect = (rate - system.f(self._t, x, self._u)) * self._quadrature[:, None]
            yield (self._Q_root(added) @ defect[..., None]).ravel()
            seen = self._at_samples @ coefficients * self._scale
            outputs = outputs_at(system, record.t, seen, record.u[0])
            innovation = system.output_residual(self._y, outputs)
            innovation = np.where(self._present, innovation, 0.0)
            yield (self._R_root @ innovation[..., None]).ravel()

    def _Q_root(self, added: float) -> np.ndarray:
        """Return roots of the inverse of the process noise's density, (num_points or 1, nx, nx)."""
        return _inverse_root(self._density + np.diag((added * self._scale) ** 2))

    def linearised(self, coefficients: np.ndarray, added: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the Hessian JᵀJ (num·nx, num·nx) and half the gradient Jᵀr (num·nx,) of
        Gauss-Newton's method at coefficients (num, nx), by all coefficients of the first state,
        then the next; see `loss`."""
        system, record, scale = self.system, self.record, self._scale
        prior, *residuals = self._residuals(coefficients, added)
        x, seen = (a @ coefficients * scale for a in (self._values, self._at_samples))
        with np.errstate(all="ignore"):
            A = np.asarray(system.f_jacobian(self._t, x, self._u)) * scale
            H = np.asarray(system.h_jacobian(record.t, seen, record.u[0])) * scale
        by_rate = self._Q_root(added) * self._quadrature[:, None, None] * scale
        by_value = -by_rate / scale @ A
        blocks = [
            (prior, self._prior_root[None] * scale, None, self._values[:1]),
            (residuals[0], by_value, by_rate, self._values),
            (residuals[1], -self._R_root @ H, None, self._at_samples),
        ]
        size = coefficients.size
        hessian, gradient = np.zeros((size, size)), np.zeros(size)
        for residual, value, rate, neurons in blocks:
            J = self._by_coefficients(value, rate, neurons)
            hessian += J.T @ J
            gradient += J.T @ residual
        return hessian, gradient

    def _by_coefficients(
        self, value: np.ndarray, rate: np.ndarray | None, neurons: np.ndarray
    ) -> np.ndarray:
        """Return the Jacobian (num_times·m, num·nx) of residuals by the coefficients, given those
        by x̂ and by its rate, (num_times, m, nx) each, and the neurons at these times."""
        n, m, nx = value.shape
        J = np.empty((n, m, nx, neurons.shape[1]))
        for i in range(m):
            for j in range(nx):
                np.multiply(value[:, i, j, None], neurons, out=J[:, i, j])
                if rate is not None and rate[:, i, j].any():
                    J[:, i, j] += rate[:, i, j, None] * self._rates
        return J.reshape(n * m, -1)

    def covariance(self, theta: np.ndarray, t: np.ndarray) -> tuple[np.ndarray, float] | None:
        """Return Laplace's approximation at weights theta (n,): the covariances of x̂ (num_times,
        nx, nx) at times t (num_times,) in s, and the square of the distance to the mode in standard
        deviations; None if the Hessian is not positive definite."""
        hessian, gradient = self.linearised(self.coefficients(theta), 0.0)
        try:
            root = np.tril(cho_factor(hessian, lower=True)[0])
        except (LinAlgError, ValueError):  # not positive, or not finite
            return None
        distance = float(gradient @ cho_solve((root, True), gradient))
        at = self.neurons(t)[0] @ self._basis
        nx, num = self.system.nx, at.shape[1]
        # x̂ᵢ is scaleᵢ·at·cᵢ, and the covariance of c is (root·rootᵀ)⁻¹.
        spread = np.zeros((nx, hessian.shape[0], len(t)))
        for i in range(nx):
            by = np.zeros((hessian.shape[0], len(t)))
            by[i * num : (i + 1) * num] = self._scale[i] * at.T
            spread[i] = solve_triangular(root, by, lower=True)
        return np.einsum("ick,jck->kij", spread, spread, optimize=True), distance


def _inverse_root(P: np.ndarray) -> np.ndarray:
    """Return W (..., n, n) with WᵀW = P⁻¹, for covariances P (..., n, n)."""
    return np.linalg.inv(np.linalg.cholesky(P))
