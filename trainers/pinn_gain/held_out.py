"""Validation on held-out records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pinnobs_gym.estimation.learned.gain_network import Variant, shapes
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.estimators.pinn_gain import PinnGain, TrainedGain
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.record import Prior
from trainers.pinn_gain.rollout import Model
from trainers.pinn_gain.streams import Data

LEVELS = (1.0, 5.0)
"""Output noise of the validation, over that given to the trainer."""
_LOST = 10.0
"""Upper bound of a scaled error, which also replaces an error that is not finite."""


class HeldOut:
    """Smoothed records with simulated outputs at each of `LEVELS`; the noise draws are fixed.

    Args:
        model: the model and the variant of the network.
        data: the smoothed records.
        facts: training metadata; their noise is that of level one.
        process_noise: the process noise given to the trainer.
    """

    def __init__(
        self, model: Model, data: Data, facts: Mapping[str, Any], process_noise: Level | None
    ) -> None:
        self._model, self._data, self._facts = model, data, facts
        self._process_noise = process_noise
        std = np.sqrt(np.einsum("iib->i", model.noise.R(0.0)))
        # Outputs of every record at every noise level.
        count = len(data.x)
        rows = np.tile(np.arange(count), len(LEVELS))
        self._std = np.repeat(np.multiply.outer(std, LEVELS), count, axis=1)  # (ny, rows)
        noise = np.random.default_rng(0).standard_normal((*data.y[rows].shape,))
        self._y = data.y[rows] + noise * self._std.T[:, None]
        self._rows, self._scale = rows, model.scale.numpy()[:, 0]
        # The errors of the EKF, by a network of zeros.
        sizes = shapes("kalman", model.system.nx, model.system.ny, 1)
        nothing = tuple((np.zeros(size), np.zeros(size[0])) for size in sizes)
        self._ekf = self._errors(nothing, "kalman")

    def loss(self, layers: Layers) -> float:
        """Return the geometric mean of the root mean square error over that of the EKF.

        Errors are deviations from the smoothed trajectories. The mean is over records, noise levels
        and two windows: all samples, and the last quarter. It is 1 for a network that does not
        change the Kalman gain.
        """
        ratio = self._errors(layers, self._model.variant) / self._ekf
        return float(np.exp(np.log(ratio).mean()))

    def _errors(self, layers: Layers, variant: Variant) -> np.ndarray:
        """Return the root mean square scaled errors (windows, rows)."""
        data, rows = self._data, self._rows
        trained = TrainedGain(**self._facts, layers=layers, variant=variant)
        told = trained.noise_std, self._process_noise
        gain = PinnGain(self._model.system, *told, trained=trained)
        R = np.eye(len(self._std))[..., None] * self._std**2
        state = gain.begin(Prior(data.mean[rows], data.cov[rows]), R)
        square = np.empty((len(data.t), len(rows)))
        with np.errstate(all="ignore"):
            for k, t in enumerate(data.t):
                state = gain.update(state, float(t), self._y[:, k], data.u[rows, k])
                error = self._model.system.state_residual(state.xhat, data.x[rows, k])
                square[k] = ((error / self._scale) ** 2).mean(axis=-1)
        # Bound the errors of diverged rows.
        square = np.where(np.isfinite(square), np.minimum(square, _LOST**2), _LOST**2)
        tail = square[-max(1, len(square) // 4) :]
        return np.sqrt([square.mean(axis=0), tail.mean(axis=0)])
