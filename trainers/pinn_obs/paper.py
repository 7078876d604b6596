"""The paper's recipe: Adam on a random part of the samples."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture, Network
from trainers.pinn_obs.adam import Adam
from trainers.pinn_obs.objective import Objective, Weights
from trainers.pinn_obs.points import samples_of
from trainers.pinn_obs.run import Run


class PaperRun(Run):
    """Adam on all training samples at once, the terms' weights those of the config."""

    def _architecture(self) -> Architecture:
        config, system = self.config, self.system
        sizes = (system.nx, system.ny, config.depth, config.width)
        architecture = Architecture(*sizes, config.activation, config.dtype)
        order = np.random.default_rng(config.seed).permutation(self.record.num_samples)
        count = max(1, round(config.train_fraction * len(order)))
        self.objective = self._loss_on(architecture, order[:count])
        left = order[count:]
        self._held_out = self._loss_on(architecture, left) if len(left) else None
        return architecture

    def _loss_on(self, architecture: Architecture, samples: np.ndarray) -> Objective:
        """The paper's loss on samples of these indices (num_samples,)."""
        config, nx, ny = self.config, self.system.nx, self.system.ny
        each = np.full(nx, config.w0), np.full(nx, config.w_ode), np.full(ny, config.w_y)
        points = samples_of(self.system, self.record, samples)
        return Objective(architecture, self.system, points, Weights(*each))

    def _drawn(self, generator: torch.Generator) -> Network:
        return Network(self.architecture, generator)

    def _begun(self, theta: np.ndarray) -> Adam:
        return Adam.start(self.objective, theta, self.config.learning_rate)

    def held_out(self) -> float | None:
        return None if self._held_out is None else self.total(self._held_out.terms(self.theta))

    def _state(self) -> dict[str, Any]:
        method = self._method
        assert isinstance(method, Adam)
        arrays = {n: getattr(method, n) for n in ("x", "gradient", "mean", "square")}
        tensors = {name: torch.from_numpy(array) for name, array in arrays.items()}
        return {**tensors, "f": method.f, "steps": method.steps}

    def _resumed(self, state: Mapping[str, Any]) -> Adam:
        x, gradient, mean, square = (state[n].numpy() for n in ("x", "gradient", "mean", "square"))
        rate = self.config.learning_rate
        return Adam(x, state["f"], gradient, rate, mean, square, state["steps"])
