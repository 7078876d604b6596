"""The base class of trainers: a training in progress, one iteration at a time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned.trained import Ending, Trained
from pinnobs_gym.estimation.learned.trained_file import plain
from pinnobs_gym.estimation.takes import EVERYTHING, check_taken
from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.kernels.asked import ask
from pinnobs_gym.simulation.noise import Level
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.settings import TrainingConfig, changed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAINING_SEED = 10**6
"""Seed of the first training episode of training seed 0; further episodes have the seeds after it.
No estimator is scored on them."""
_APART = 10**4
"""Episode seeds between those of two training seeds."""


def first_episode(seed: int) -> int:
    """Return the seed of the first training episode of a training seed: trainings of different
    seeds have different episodes."""
    return TRAINING_SEED + _APART * seed


ConfigT = TypeVar("ConfigT", bound=TrainingConfig)
TrainedT = TypeVar("TrainedT", bound=Trained)


class Trainer(ABC, Generic[ConfigT, TrainedT]):
    """A training in progress.

    `pinnobs_gym.training.loop.train` runs it to its end, and handles the progress bar, the log,
    checkpoints, resumption, the budget and Ctrl-C. The registry finds a trainer as a class in a
    module of ``trainers`` that assigns ``name``.

    Args:
        system: the model.
        config: the settings.
        record: the training samples and the prior; NaN marks a missing output. None for a trainer
            that plays episodes itself.
        noise_std: the output noise, as `Setup.noise_std`; that of the benchmark setup if None.
        process_noise: the process noise, as `Setup.process_noise`; that of the benchmark setup if
            None.
        game: source of the episodes, for a trainer that plays episodes itself.
        episode: seed of the first episode that such a trainer plays.
        condition: name of the condition of the record's episodes; a game has its own.

    Raises:
        ValueError: in one line, if training is impossible with these arguments.
    """

    name: ClassVar[str]
    """Name of the trainer, which its estimators give in ``needs_training``."""
    presets: ClassVar[Mapping[str, Callable[[], Any]]]
    """Functions by name, each of which returns a complete Config; the first is the default."""
    takes: ClassVar[frozenset[str]] = EVERYTHING
    """What a plant may have, as `BaseEstimator.takes` of the estimators that need the trainer. A
    plant with anything else is refused before the training."""
    simulates: ClassVar[bool] = False
    """Whether the trainer learns from episodes that it simulates with the model; others learn from
    the outputs of their record, which may be those of sensor logs."""
    paced_by_budget: ClassVar[bool] = False
    """Whether `finished` takes the budget into account, because the schedule depends on it."""

    def __init__(
        self,
        system: System,
        config: ConfigT,
        *,
        record: Record | None = None,
        noise_std: Level | None = None,
        process_noise: Level | None = None,
        game: Game | None = None,
        episode: int = TRAINING_SEED,
        condition: str = "nominal",
    ) -> None:
        if (record is None) == (game is None):
            raise ValueError(f"trainer {self.name!r} takes either a record or a game")
        config.check_shared()  # a Config with a __post_init__ of its own may have left it out
        self.system, self.config = system, config
        self.levels = noise_std, process_noise
        self.noise = system.noise(*self.levels)
        check_taken(type(self), system, self.noise)
        self.noise_std = np.sqrt(np.einsum("iib->i", self.noise.R(0.0)))
        self.episode = episode
        self.condition = condition if game is None else game.name.condition
        self.iteration = 0
        """Number of iterations so far."""
        self.ending: Ending = "running"
        self._record, self._game = record, game
        for template in ("truth", "model"):
            ask(system, template)  # now, so that a training does not depend on calls before it
        self._earlier, self._started_at = 0.0, time.process_time()
        self.start()

    @classmethod
    def configured(cls, changes: Mapping[str, Any]) -> Any:
        """Return the Config of a preset with some settings changed.

        Args:
            changes: settings by name; ``preset`` names the preset, the first one by default.

        Raises:
            ValueError: in one line, if the preset or a setting is unknown, or a value is not
                allowed.
        """
        settings = dict(changes)
        name = settings.pop("preset", next(iter(cls.presets)))
        if name not in tuple(cls.presets):  # whatever the name is, also a list
            known = ", ".join(cls.presets)
            guess = did_you_mean(name, cls.presets)
            raise ValueError(f"preset={name!r}; expected one of {known}{guess}")
        return changed(cls.presets[name](), settings)

    @property
    def record(self) -> Record:
        """The training record.

        Raises:
            ValueError: if the trainer was given a game.
        """
        if self._record is None:
            raise ValueError(f"trainer {self.name!r} learns from a record; it was given a game")
        return self._record

    @property
    def game(self) -> Game:
        """The source of the episodes.

        Raises:
            ValueError: if the trainer was given a record.
        """
        if self._game is None:
            raise ValueError(f"trainer {self.name!r} plays episodes; it was given a record")
        return self._game

    @property
    def has_record(self) -> bool:
        """Whether the trainer was given a record."""
        return self._record is not None

    @property
    def seconds(self) -> float:
        """CPU seconds so far, including those before a resumption."""
        return self._earlier + time.process_time() - self._started_at

    def continue_from(self, iteration: int, seconds: float) -> None:
        """Continue the counts of iterations and CPU seconds of an interrupted training."""
        self.iteration = iteration
        self._earlier += seconds

    def facts(self, *, loss: float, seed: int) -> dict[str, Any]:
        """Return the current values of the fields that all `Trained` share.

        Args:
            loss: the least loss.
            seed: seed of the initial weights.
        """
        system = self.system
        return {
            "trainer": self.name,
            "system": type(system).__name__,
            "parameters": plain(system.parameters),
            "noise_std": tuple(self.noise_std.tolist()),
            "condition": self.condition,
            "config": plain(asdict(self.config)),
            "seed": seed,
            "loss": loss,
            "iterations": self.iteration,
            "seconds": self.seconds,
            "ending": self.ending,
        }

    @abstractmethod
    def start(self) -> None:
        """Check and prepare the training data, and draw the initial weights.

        Raises:
            ValueError: in one line, if training is impossible with the data or settings.
        """

    @abstractmethod
    def step(self) -> None:
        """Make one iteration, and increment ``iteration``."""

    @abstractmethod
    def finished(self) -> bool:
        """Return whether the training is complete; the loop checks the budget, unless
        ``paced_by_budget``."""

    @abstractmethod
    def progress(self) -> float:
        """Return the finished fraction of the training, from 0 to 1."""

    @abstractmethod
    def status(self) -> str:
        """Return a few words for the progress bar."""

    @abstractmethod
    def curves(self) -> Mapping[str, float]:
        """Return the current values of the logged curves by tag."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """Return all that `load_state` needs to resume exactly: tensors, arrays, plain values."""

    @abstractmethod
    def load_state(self, state: Mapping[str, Any]) -> None:
        """Restore the result of `state`; ``iteration`` is already restored."""

    @abstractmethod
    def result(self) -> TrainedT:
        """Return the trained object with the best weights so far.

        Raises:
            FloatingPointError: in one line, if no loss was finite.
        """

    @abstractmethod
    def figures(self, trained: TrainedT) -> Mapping[str, Figure]:
        """Return Matplotlib figures of the trained object by name."""
