"""The paper's recipe: Adam on a random part of the samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.adam import Adam
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.objective import Objective, Weights
from trainers.pinn_obs.passes import draw_layers, flattened
from trainers.pinn_obs.points import samples_of
from trainers.pinn_obs.recipe import Recipe


class PaperRecipe(Recipe[Objective, Adam]):
    """Adam on all training samples at once, with the config's weights of the loss terms.

    The network's input is the time in s as in the paper, whose records begin at zero, but counted
    from the record's first sample. At the time 1000 s all neurons of the first layer would be
    saturated, and training would find nothing but a constant.
    """

    def __init__(self, system: System, config: PinnObsConfig, record: Record, noise: Noise) -> None:
        self.config, self.system, self.record = config, system, record
        sizes = (system.nx, system.ny, config.depth, config.width)
        start = float(record.t[0])
        self.architecture = Architecture(*sizes, config.activation, config.dtype, start=start)
        # A random split of the samples into training and validation.
        order = np.random.default_rng(config.seed).permutation(record.num_samples)
        count = max(1, round(config.train_fraction * len(order)))
        self.objective = self._loss_on(order[:count])
        held_out = order[count:]
        self._held_out = self._loss_on(held_out) if len(held_out) else None

    def _loss_on(self, samples: np.ndarray) -> Objective:
        """Return the paper's loss on the samples of these indices (num_samples,)."""
        config, nx, ny = self.config, self.system.nx, self.system.ny
        each = np.full(nx, config.w0), np.full(nx, config.w_ode), np.full(ny, config.w_y)
        points = samples_of(self.system, self.record, samples)
        return Objective(self.architecture, self.system, points, Weights(*each))

    def draw(self, generator: torch.Generator) -> np.ndarray:
        return flattened(draw_layers(self.architecture, generator))

    def begin(self, theta: np.ndarray) -> Adam:
        return Adam.start(self.objective, theta, self.config.learning_rate)

    def held_out(self, theta: np.ndarray) -> float | None:
        if self._held_out is None:
            return None
        config = self.config
        terms = self._held_out.terms(theta)
        return float(terms @ [config.w0, config.w_ode, config.w_y])

    def completed(self, trained: TrainedNetwork) -> TrainedNetwork:
        return trained

    def covariance(self, theta: np.ndarray) -> None:
        return None

    def method_state(self, method: Adam) -> dict[str, Any]:
        names = ("x", "f", "gradient", "mean", "square", "steps")
        return {name: getattr(method, name) for name in names}

    def load_method(self, state: Mapping[str, Any], best: tuple[np.ndarray, float]) -> Adam:
        return Adam(**state, learning_rate=self.config.learning_rate)
