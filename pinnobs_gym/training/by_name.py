"""Training by the name of a trainer, and loading of trained estimators."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import AnyGame, Game
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


LOGS = "logs"
"""What stands for the condition of records that are those of sensor logs."""


def trainer_on_logs(
    name: str | type[Trainer[Any, Any]],
    config: TrainingConfig,
    system: System,
    setup: Setup,
    record: Record,
) -> Trainer[Any, Any]:
    """Create the trainer of a name for recorded outputs, ready for its first iteration.

    Args:
        name: name, ``module:Class`` or class of the trainer.
        config: its Config; the number of records is that of ``record``.
        system: the model.
        setup: its noise.
        record: the samples of one or several logs, and the prior.

    Raises:
        ValueError: in one line, if the trainer simulates episodes in place of learning from
            outputs, learns from another number of records, or cannot be trained on these.
    """
    cls = TRAINERS.resolve(name)
    if cls.simulates or not config.records:
        raise ValueError(
            f"trainer {cls.name!r} learns from episodes that it simulates with the model, and from "
            "their states; it makes no use of a log: train it without --log"
        )
    levels = {"noise_std": setup.noise_std, "process_noise": setup.process_noise}
    config = config.for_records(record.batch)
    return cls(system, config, **levels, record=record, condition=LOGS)


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


def load(cls: type[BaseEstimator], path: Path, game: AnyGame) -> BaseEstimator:
    """Load a trained estimator for a game; one that uses the noise gets that of the game's setup.

    Raises:
        ValueError: in one line, if the class is not a learned estimator, or if the file cannot be
            read or belongs to another system.
    """
    return _loaded(cls, path, game.source.system, game.source.setup)


def load_for_log(
    cls: type[BaseEstimator], path: Path, system: System, setup: Setup, record: Record
) -> BaseEstimator:
    """Load a trained estimator for the record of a log; one that uses the noise gets that of the
    setup.

    Raises:
        ValueError: in one line, as `load`, or if the estimator cannot be used at the times of the
            record.
    """
    estimator = _loaded(cls, path, system, setup)
    check_times(estimator, record, str(path))
    return estimator


def check_times(estimator: BaseEstimator, record: Record, what: str) -> None:
    """Check that a trained estimator can be used at the times of a log's record.

    Args:
        estimator: the estimator.
        record: the samples.
        what: the trained object, for the message.

    Raises:
        ValueError: in one line, if it cannot.
    """
    if isinstance(estimator, LearnedEstimator) and (reason := estimator.unfit(record.t)):
        raise ValueError(f"{what} {reason}")


def _loaded(cls: type[BaseEstimator], path: Path, system: System, setup: Setup) -> BaseEstimator:
    """Load a trained estimator with a model and, if it uses the noise, that of a setup."""
    if not issubclass(cls, LearnedEstimator):
        name = getattr(cls, "name", cls.__name__)
        raise ValueError(f"estimator {name!r} is not one that is trained first")
    estimator: Any = cls.load(path, system)
    if "noise" not in cls.knows:
        return estimator
    return replace(estimator, noise_std=setup.noise_std, process_noise=setup.process_noise)
