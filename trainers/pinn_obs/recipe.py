"""What the paper's recipe and the fast one differ in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimators.pinn_obs import Covariance
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.minimum import Minimiser
from trainers.pinn_obs.objective import Objective


class Recipe(ABC):
    """How a network is made, what is minimised, and by which method.

    Args:
        system: the model.
        config: the settings.
        record: of one episode.
        noise_std: standard deviation of the output noise, shape (ny,), in output units.
    """

    architecture: Architecture
    """The network's sizes."""
    objective: Objective
    """What is minimised, of a network's weights."""

    @abstractmethod
    def __init__(
        self, system: System, config: PinnObsConfig, record: Record, noise_std: np.ndarray
    ) -> None: ...

    @abstractmethod
    def draw(self, generator: torch.Generator) -> np.ndarray:
        """Random weights (n,)."""

    @abstractmethod
    def begin(self, theta: np.ndarray) -> Minimiser:
        """The minimisation from weights theta (n,)."""

    @abstractmethod
    def held_out(self, theta: np.ndarray) -> float | None:
        """The paper's loss on samples that are not trained on, if there are any."""

    @abstractmethod
    def covariance(self, theta: np.ndarray) -> Covariance | None:
        """Covariances of the estimates of the network with weights theta (n,), if they are
        known."""

    @abstractmethod
    def method_state(self, method: Minimiser) -> dict[str, Any]:
        """All that `load_method` needs to go on exactly: arrays and plain values."""

    @abstractmethod
    def load_method(self, state: Mapping[str, Any], best: tuple[np.ndarray, float]) -> Minimiser:
        """The minimisation that goes on from what `method_state` gave; ``best`` are the best
        weights (n,) and their loss."""
