"""The interface of recipes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

import numpy as np
import torch

from pinnobs_gym.estimation.learned.mlp import Architecture
from pinnobs_gym.estimators.pinn_obs import Covariance, TrainedNetwork
from pinnobs_gym.simulation.noise import Noise
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from trainers.pinn_obs.config import PinnObsConfig
from trainers.pinn_obs.minimum import Loss

LossT = TypeVar("LossT", bound=Loss)
MethodT = TypeVar("MethodT")


class Recipe(ABC, Generic[LossT, MethodT]):
    """Base class of recipes: a network, an objective and a minimiser.

    Args:
        system: the model.
        config: the settings.
        record: record of one episode.
        noise: the noise of the plant and of its outputs.
    """

    architecture: Architecture
    """Architecture of the network."""
    objective: LossT
    """The minimised loss as a function of the network's weights."""

    @abstractmethod
    def __init__(
        self, system: System, config: PinnObsConfig, record: Record, noise: Noise
    ) -> None: ...

    @abstractmethod
    def draw(self, generator: torch.Generator) -> np.ndarray:
        """Draw initial weights (n,)."""

    @abstractmethod
    def begin(self, theta: np.ndarray) -> MethodT:
        """Begin the minimisation at weights theta (n,)."""

    @abstractmethod
    def held_out(self, theta: np.ndarray) -> float | None:
        """Return the paper's loss on held-out samples; None if there are none."""

    @abstractmethod
    def completed(self, trained: TrainedNetwork) -> TrainedNetwork:
        """Return the trained network with what is computed when its training is over."""

    @abstractmethod
    def covariance(self, theta: np.ndarray) -> Covariance | None:
        """Return the covariances of the estimates of the network with weights theta (n,); None if
        they are unknown."""

    @abstractmethod
    def method_state(self, method: MethodT) -> dict[str, Any]:
        """Return all that `load_method` needs to resume exactly: arrays and plain values."""

    @abstractmethod
    def load_method(self, state: Mapping[str, Any], best: tuple[np.ndarray, float]) -> MethodT:
        """Restore the minimisation from the result of `method_state`; ``best`` are the best weights
        (n,) and their loss."""
