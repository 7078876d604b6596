"""The interface of the paper's and the fast recipe."""

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
    """Base class of recipes: a network, an objective and a minimiser.

    Args:
        system: the model.
        config: the settings.
        record: record of one episode.
        noise_std: standard deviation of the output noise, shape (ny,), in output units.
    """

    architecture: Architecture
    """Architecture of the network."""
    objective: Objective
    """The minimised loss as a function of the network's weights."""

    @abstractmethod
    def __init__(
        self, system: System, config: PinnObsConfig, record: Record, noise_std: np.ndarray
    ) -> None: ...

    @abstractmethod
    def draw(self, generator: torch.Generator) -> np.ndarray:
        """Draw initial weights (n,)."""

    @abstractmethod
    def begin(self, theta: np.ndarray) -> Minimiser:
        """Begin the minimisation at weights theta (n,)."""

    @abstractmethod
    def held_out(self, theta: np.ndarray) -> float | None:
        """Return the paper's loss on held-out samples; None if there are none."""

    @abstractmethod
    def covariance(self, theta: np.ndarray) -> Covariance | None:
        """Return the covariances of the estimates of the network with weights theta (n,); None if
        they are unknown."""

    @abstractmethod
    def method_state(self, method: Minimiser) -> dict[str, Any]:
        """Return all that `load_method` needs to resume exactly: arrays and plain values."""

    @abstractmethod
    def load_method(self, state: Mapping[str, Any], best: tuple[np.ndarray, float]) -> Minimiser:
        """Restore the minimisation from the result of `method_state`; ``best`` are the best weights
        (n,) and their loss."""
