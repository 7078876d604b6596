"""What a trainer is: a training in progress, one iteration at a time."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, ClassVar, Generic, TypeVar

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned.trained import Ending, Trained
from pinnobs_gym.estimation.learned.trained_file import plain
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.training.settings import TrainingConfig, changed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TRAINING_SEED = 10**6
"""Seed of the first episode that an estimator trained beforehand learns from; further ones have the
seeds after it. None is scored on them."""

ConfigT = TypeVar("ConfigT", bound=TrainingConfig)
TrainedT = TypeVar("TrainedT", bound=Trained)


class Trainer(ABC, Generic[ConfigT, TrainedT]):
    """A training in progress. `pinnobs_gym.training.loop.train` runs it to its end; it owns the
    progress bar, the log, checkpoints, resumption, the budget and Ctrl-C.

    A trainer is a class of a module of ``trainers`` that assigns ``name``; it is found by that.

    Args:
        system: the model.
        config: the recipe.
        record: the samples that are learned from, and the prior; NaN is a missing output. None for
            a trainer that plays episodes itself.
        noise_std: standard deviation of the output noise in output units, shape (ny,) or one number
            for all outputs; that of the benchmark setup if None.
        game: what is played, for a trainer that plays episodes itself.
        episode: seed of the first episode that is played.

    Raises:
        ValueError: in one line, if it cannot be trained with these.
    """

    name: ClassVar[str]
    """What it is called, and what estimators say in ``needs_training``."""
    presets: ClassVar[Mapping[str, Callable[[], Any]]]
    """Functions that return a whole Config each, by name; the first is the default."""
    paced_by_budget: ClassVar[bool] = False
    """Whether it lays its own schedule out over the budget, and so is finished by it."""

    def __init__(
        self,
        system: System,
        config: ConfigT,
        *,
        record: Record | None = None,
        noise_std: Sequence[float] | float | None = None,
        game: Game | None = None,
        episode: int = TRAINING_SEED,
    ) -> None:
        known_noise = system.setups["benchmark"].noise_std if noise_std is None else noise_std
        if (record is None) == (game is None):
            raise ValueError(f"trainer {self.name!r} takes either a record or a game")
        self.system, self.config = system, config
        self.noise_std = vector(known_noise, system.ny, "noise_std")
        self.episode = episode
        self.iteration = 0
        """Iterations made so far."""
        self.ending: Ending = "running"
        self._record, self._game = record, game
        self._earlier, self._started_at = 0.0, time.process_time()
        self.start()

    @classmethod
    def configured(cls, changes: Mapping[str, Any]) -> Any:
        """The Config of a preset with some settings changed.

        Args:
            changes: settings by name; ``preset`` names the preset, the first one if left out.

        Raises:
            ValueError: in one line, if the preset or a setting is unknown or not allowed.
        """
        left = dict(changes)
        name = left.pop("preset", next(iter(cls.presets)))
        if name not in cls.presets:
            raise ValueError(f"preset={name!r}; expected one of {', '.join(cls.presets)}")
        return changed(cls.presets[name](), left)

    @property
    def record(self) -> Record:
        """The samples that are learned from."""
        if self._record is None:
            raise ValueError(f"trainer {self.name!r} learns from a record; it was given a game")
        return self._record

    @property
    def game(self) -> Game:
        """What is played."""
        if self._game is None:
            raise ValueError(f"trainer {self.name!r} plays episodes; it was given a record")
        return self._game

    @property
    def has_record(self) -> bool:
        """Whether it learns from a record."""
        return self._record is not None

    @property
    def seconds(self) -> float:
        """CPU seconds so far, those before a resumption included."""
        return self._earlier + time.process_time() - self._started_at

    def continue_from(self, iteration: int, seconds: float) -> None:
        """Count on from an interrupted training's iterations and CPU seconds."""
        self.iteration = iteration
        self._earlier += seconds

    def facts(self, *, loss: float, seed: int) -> dict[str, Any]:
        """The fields that all `Trained` have, as they are now.

        Args:
            loss: the least loss.
            seed: what the weights were drawn from.
        """
        system = self.system
        return {
            "trainer": self.name,
            "system": type(system).__name__,
            "parameters": plain(system.parameters),
            "noise_std": tuple(self.noise_std.tolist()),
            "config": plain(asdict(self.config)),
            "seed": seed,
            "loss": loss,
            "iterations": self.iteration,
            "seconds": self.seconds,
            "ending": self.ending,
        }

    @abstractmethod
    def start(self) -> None:
        """Check and prepare what is learned from, and draw the first weights.

        Raises:
            ValueError: in one line, if it cannot be trained with what it was given.
        """

    @abstractmethod
    def step(self) -> None:
        """Make one iteration, and count it in ``iteration``."""

    @abstractmethod
    def finished(self) -> bool:
        """Whether the training is over by itself, whatever its budget."""

    @abstractmethod
    def progress(self) -> float:
        """How much of the training is over, from 0 to 1."""

    @abstractmethod
    def status(self) -> str:
        """What the progress bar says, in a few words."""

    @abstractmethod
    def curves(self) -> Mapping[str, float]:
        """Values of the logged curves after this iteration, by tag."""

    @abstractmethod
    def state(self) -> dict[str, Any]:
        """All that `load_state` needs to go on exactly: tensors, arrays and plain values."""

    @abstractmethod
    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from what `state` gave; ``iteration`` is already that of the state."""

    @abstractmethod
    def result(self) -> TrainedT:
        """The best of what was trained so far.

        Raises:
            FloatingPointError: in one line, if no loss was finite.
        """

    @abstractmethod
    def figures(self, trained: TrainedT) -> Mapping[str, Figure]:
        """Pictures of what was trained, by name."""
