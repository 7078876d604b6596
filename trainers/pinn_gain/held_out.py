"""The records that only decide which weights are kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pinnobs_gym.estimation.learned.gain_network import Variant, shapes
from pinnobs_gym.estimation.learned.perceptron import Layers
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import PinnGain, TrainedGain
from pinnobs_gym.simulation.record import Prior
from trainers.pinn_gain.rollout import Model
from trainers.pinn_gain.streams import Data

LEVELS = (1.0, 5.0)
"""Noise levels over that which training is told, at which weights are judged."""
_LOST = 10.0
"""Scaled error at which one is cut off, and which one stands for that is not finite."""


class HeldOut:
    """Smoothed records, measured anew at each of `LEVELS`, always with the same noise.

    Args:
        model: what is rolled out.
        data: the records.
        facts: of the training; their noise is that of level one.
    """

    def __init__(self, model: Model, data: Data, facts: Mapping[str, Any]) -> None:
        self._model, self._data, self._facts = model, data, facts
        std = np.sqrt(EKF(model.system, facts["noise_std"]).output_variance)
        count = len(data.x)
        rows = np.tile(np.arange(count), len(LEVELS))
        self._std = np.repeat(np.multiply.outer(std, LEVELS), count, axis=1)  # (ny, rows)
        noise = np.random.default_rng(0).standard_normal((*data.y[rows].shape,))
        self._y = data.y[rows] + noise * self._std.T[:, None]
        self._rows, self._scale = rows, model.scale.numpy()[:, 0]
        sizes = shapes("kalman", model.system.nx, model.system.ny, 1)
        nothing = tuple((np.zeros(size), np.zeros(size[0])) for size in sizes)
        self._ekf = self._errors(nothing, "kalman")

    def loss(self, layers: Layers) -> float:
        """The geometric mean, over records, noise levels, and two windows (all samples, and the
        last quarter), of the root mean square distance from the smoothed trajectory over the EKF's;
        one for a network that changes nothing."""
        ratio = self._errors(layers, self._model.variant) / self._ekf
        return float(np.exp(np.log(ratio).mean()))

    def _errors(self, layers: Layers, variant: Variant) -> np.ndarray:
        """Root mean square scaled errors (windows, rows)."""
        data, rows = self._data, self._rows
        trained = TrainedGain(**self._facts, layers=layers, variant=variant)
        gain = PinnGain(self._model.system, trained.noise_std, trained=trained)
        state = gain.begin(Prior(data.mean[rows], data.cov[rows]), self._std**2)
        square = np.empty((len(data.t), len(rows)))
        with np.errstate(all="ignore"):
            for k, t in enumerate(data.t):
                state = gain.update(state, float(t), self._y[:, k], data.u[rows, k])
                square[k] = (((state.xhat - data.x[rows, k]) / self._scale) ** 2).mean(axis=-1)
        square = np.where(np.isfinite(square), np.minimum(square, _LOST**2), _LOST**2)
        tail = square[-max(1, len(square) // 4) :]
        return np.sqrt([square.mean(axis=0), tail.mean(axis=0)])
