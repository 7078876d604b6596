"""Training by the name of a trainer, and loading of trained estimators."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.training.loop import train
from pinnobs_gym.training.settings import TrainingConfig
from pinnobs_gym.training.trainer import Trainer, first_episode


def trainer_of(
    name: str | type[Trainer[Any, Any]],
    config: TrainingConfig,
    game: Game,
    episode: int | None = None,
) -> Trainer[Any, Any]:
    """Create the trainer of a name for a game, ready for its first iteration.

    It is given the record of ``config.records`` episodes, or the game itself if that is 0.

    Args:
        name: name, ``module:Class`` or class of the trainer.
        config: its Config.
        game: source of the episodes.
        episode: seed of the first episode; `first_episode` of the training seed if None.
    """
    cls, source = TRAINERS.resolve(name), game.source
    first = first_episode(config.seed) if episode is None else episode
    if first < 0:
        raise ValueError(f"episode={first}; expected a whole number of at least 0")
    data: dict[str, Any] = {"game": game, "episode": first}
    if config.records:
        record = game.record(range(first, first + config.records))
        data = {"record": record, "condition": game.name.condition}
    setup = source.setup
    levels = {"noise_std": setup.noise_std, "process_noise": setup.process_noise}
    return cls(source.system, config, **levels, **data)


def train_by_name(
    name: str | type[Trainer[Any, Any]],
    config: TrainingConfig,
    game: Game,
    episode: int | None = None,
    **options: Any,
) -> Trained:
    """Train with the trainer of a name, and return the trained object; see `trainer_of`.

    Args:
        name: name, ``module:Class`` or class of the trainer.
        config: its Config.
        game: source of the episodes.
        episode: seed of the first episode; `first_episode` of the training seed if None.
        options: ``log``, ``checkpoint``, ``resume`` and ``progress`` of `train`.
    """
    return train(trainer_of(name, config, game, episode), **options)


def load(cls: type[BaseEstimator], path: Path, game: Game) -> BaseEstimator:
    """Load a trained estimator for a game; one that uses the noise gets that of the game's setup.

    Raises:
        ValueError: in one line, if the class is not a learned estimator, or if the file cannot be
            read or belongs to another system.
    """
    if not issubclass(cls, LearnedEstimator):
        name = getattr(cls, "name", cls.__name__)
        raise ValueError(f"estimator {name!r} is not one that is trained first")
    estimator: Any = cls.load(path, game.source.system)
    setup = game.source.setup
    if "noise" not in cls.knows:
        return estimator
    return replace(estimator, noise_std=setup.noise_std, process_noise=setup.process_noise)


def load_for_log(
    cls: type[BaseEstimator], path: Path, system: System, setup: Setup, record: Record
) -> BaseEstimator:
    """Load a trained estimator for the record of a log; one that uses the noise gets that of the
    setup.

    Raises:
        ValueError: in one line, as `load`, or if the estimator cannot be used at the times of the
            record.
    """
    if not issubclass(cls, LearnedEstimator):
        name = getattr(cls, "name", cls.__name__)
        raise ValueError(f"estimator {name!r} is not one that is trained first")
    estimator: Any = cls.load(path, system)
    if reason := estimator.unfit(record.t):
        raise ValueError(f"{path} {reason}")
    if "noise" not in cls.knows:
        return estimator
    return replace(estimator, noise_std=setup.noise_std, process_noise=setup.process_noise)
