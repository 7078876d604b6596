"""The recipe of the posterior: the most probable path of a network, its covariance by Laplace's
approximation, and Riccati's gain along it."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimation.smoother import forward
from pinnobs_gym.estimators.pinn_obs import Covariance, PinnObsReplay, TrainedNetwork
from pinnobs_gym.simulation.noise import AssumedNoise, Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.guide import CAUTION, observer_gain
from trainers.pinn_obs.levenberg_marquardt import LevenbergMarquardt, stages_of
from trainers.pinn_obs.path_posterior import PathPosterior
from trainers.pinn_obs.recipe import Recipe

ASSUMED = 3e-3
"""Process noise beyond the known one, as `GaussianEstimator.assumed_noise`: over each state's scale
and the benchmark's duration."""
_UNITS = 20
"""Units of time in a record."""
_WIDEST = 1.0
"""Process noise of the first stage, over the scale and the root of a unit of time."""
_SHARPNESS = 0.3
"""Distance of neighbouring neurons, over the width of their tanh."""
_MARGIN = 0.02
"""Part of the record by which the neurons reach beyond either end."""
_SHARE, _DECAYS = 4, 20
"""Every fourth neuron, but at most twenty, decays from t₀, for the gain alone."""
_DECAY = (0.5, 0.05)
"""Least of their time constants, over the first interval, and largest, over the record."""
_LAYER = (0.02, 1.0, 24)
"""First and last time in the first interval at which the gain is fitted, and their number."""
_CAUTIONS = (CAUTION, 1.0, 5.0)
"""Cautions of the Riccati recursion, of which the first is taken with which the gain replays."""
_NEAR = 0.1
"""Distance of the replay from the path that counts as near, over the scale, in the last quarter."""
_MOST_TIMES = 2000
"""Largest number of times at which the covariance is kept."""
_UNLIKELY = 5.0
"""Standard deviations of the loss beyond its mean that are told."""


class PosteriorRecipe(Recipe[PathPosterior, LevenbergMarquardt]):
    """The path of a network that is most probable a posteriori, by Levenberg and Marquardt.

    The prior of x(t₀), the noise of the outputs and the process noise are those known; see
    `PathPosterior`. As in Kalman filters, `ASSUMED` process noise is added, without which a path
    that is not exactly a solution would have no probability, and outputs without noise have
    `pinnobs_gym.simulation.noise.NOISE_FLOOR` of their scale.

    The hidden layer is fixed: neurons tanh at even times, which overlap, and a few that decay from
    t₀. Nothing is random, so that every seed gives the same. The gain is not in the loss: it is
    computed at the end, by the Riccati recursion along the path, the output layer is fitted to it
    by least squares, and it is replayed on the record.
    """

    def __init__(self, system: System, config: PinnObsConfig, record: Record, noise: Noise) -> None:
        self.config, self.system, self.record = config, system, record
        self.noise = AssumedNoise.of(system, noise, ASSUMED)
        t = record.t
        start, length, interval = float(t[0]), float(t[-1] - t[0]), float(t[1] - t[0])
        number = min(config.width // _SHARE, _DECAYS)
        slowest = max(_DECAY[1] * length, _DECAY[0] * interval)
        decays = np.geomspace(_DECAY[0] * interval, slowest, number)
        self.architecture = Architecture(
            system.nx,
            system.ny,
            config.depth,
            config.width,
            config.activation,
            config.dtype,
            span=(start, start + length),
            decays=tuple(map(float, decays)),
        )
        neurons = config.width - number
        hidden = _hidden_layer(neurons, number)
        self.objective = PathPosterior(
            self.architecture, system, record, self.noise, hidden, neurons
        )
        widest = _WIDEST / np.sqrt(length / _UNITS)
        self._stages = stages_of(float(widest), self.objective.least_noise)

    def draw(self, generator: torch.Generator) -> np.ndarray:
        return self.objective.theta(self.objective.at_rest())

    def begin(self, theta: np.ndarray) -> LevenbergMarquardt:
        coefficients = self.objective.coefficients(theta)
        return LevenbergMarquardt.start(self.objective, coefficients, self._stages)

    def held_out(self, theta: np.ndarray) -> None:
        return None

    def completed(self, trained: TrainedNetwork) -> TrainedNetwork:
        """Return the network with a gain: Riccati's along the path, with the least caution with
        which the replay of the record comes to the path. A warning says if none does."""
        t, system = self.record.t, self.system
        path, scale = trained.xhat(t), vector(system.scale, system.nx, "scale")
        late, found = slice(3 * len(t) // 4, None), []
        for caution in _CAUTIONS:
            with np.errstate(all="ignore"):
                one = self._with_gain(trained, path, caution)
                replayed = PinnObsReplay(system, trained=one).run(self.record).xhat[0]
                away = system.state_residual(replayed[late], path[late]) / scale
                distance = float(np.sqrt(np.mean(away**2)))
            if distance <= _NEAR:
                return one
            found.append((distance if np.isfinite(distance) else np.inf, one))
        what = f"the gain of PINN-Obs on {type(system).__name__} does not replay on its own record"
        warnings.warn(what, stacklevel=2)
        return min(found, key=lambda pair: pair[0])[1]

    def _with_gain(
        self, trained: TrainedNetwork, path: np.ndarray, caution: float
    ) -> TrainedNetwork:
        """Return the network with the output layer fitted to Riccati's gain along a path
        (num_samples, nx), at the points of the equation, at the samples, and within the first
        interval. ``caution`` is that of `pinnobs_gym.estimation.smoother.forward`."""
        system, record, (W, b) = self.system, self.record, trained.layers[0]
        layer = record.t[0] + (record.t[1] - record.t[0]) * np.geomspace(*_LAYER)
        times = np.unique(np.concatenate([record.t, layer, self.objective.points]))
        neurons = np.tanh(trained.architecture.features(times)[0] @ W.T + b)
        neurons = np.column_stack([neurons, np.ones(len(times))])
        L = observer_gain(
            record.t, forward(system, record, self.noise, about=path[:, None], caution=caution)
        )
        W, b = (part.copy() for part in trained.layers[-1])
        for j, seen in enumerate(~np.isnan(record.y[0]).T):
            if not np.isfinite(L).all() or seen.sum() < 2:
                continue  # the gain stays zero
            for i in range(system.nx):
                # Between samples at which the output is present. Relative errors of large gains
                # count, and absolute ones of small gains.
                target = np.interp(times, record.t[seen], L[seen, i, j])
                weight = 1 / (abs(target) + np.median(abs(target)) + 1e-300)
                fitted = np.linalg.lstsq(neurons * weight[:, None], target * weight, rcond=1e-10)[0]
                row = system.nx + i * system.ny + j
                W[row], b[row] = fitted[:-1], fitted[-1]
        return replace(trained, layers=(trained.layers[0], (W, b)))

    def covariance(self, theta: np.ndarray) -> Covariance | None:
        """Return the covariances by Laplace's approximation; None, with a warning, if the Hessian
        is not positive definite. A warning says where they are not to be trusted."""
        name, t = type(self.system).__name__, self.record.t
        chosen = np.linspace(0, len(t) - 1, min(len(t), _MOST_TIMES)).round().astype(int)
        found = self.objective.covariance(theta, t[chosen])
        if found is None:
            problem = f"the posterior of this record of {name} has no covariance"
            warnings.warn(f"{problem}: its Hessian is not positive definite", stacklevel=2)
            return None
        P, distance = found
        if distance > 1:
            problem = f"training on this record of {name} ended {distance**0.5:.3g} standard"
            advice = "deviations from the most probable path; allow more iterations"
            warnings.warn(f"{problem} {advice}", stacklevel=2)
        loss, number = float(self.objective.terms(theta).sum()), self.objective.num_outputs
        if distance <= 1 and not loss <= number + _UNLIKELY * (2 * number) ** 0.5:
            problem = f"the loss on this record of {name} is {loss:.4g}, expected about {number}"
            advice = "the model or the noise is not the plant's, or width is too small"
            warnings.warn(f"{problem}: {advice}; covariances are too small", stacklevel=2)
        return Covariance(t[chosen], P)

    def method_state(self, method: LevenbergMarquardt) -> dict[str, Any]:
        names = ("coefficients", "x", "f", "stage", "steps", "damping")
        return {name: getattr(method, name) for name in names}

    def load_method(
        self, state: Mapping[str, Any], best: tuple[np.ndarray, float]
    ) -> LevenbergMarquardt:
        return LevenbergMarquardt(**state, stages=self._stages)


def _hidden_layer(neurons: int, decays: int) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (neurons + decays, 1 + decays) and biases of the hidden layer: neurons at even
    times, and one for each decay."""
    middles = (1 + 2 * _MARGIN) * np.linspace(-1, 1, neurons)
    slope = _SHARPNESS * (neurons - 1) / 2
    W = np.zeros((neurons + decays, 1 + decays))
    W[:neurons, 0] = slope
    W[neurons:, 1:] = np.eye(decays)
    return W, np.concatenate([-slope * middles, np.zeros(decays)])
