"""Training by the name of a trainer, and loading what it made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.training.loop import train
from pinnobs_gym.training.settings import TrainingConfig
from pinnobs_gym.training.trainer import TRAINING_SEED, Trainer


def trainer_of(
    name: str, config: TrainingConfig, game: Game, episode: int = TRAINING_SEED
) -> Trainer[Any, Any]:
    """The training, not begun, of the trainer of that name on a game.

    A trainer learns from the record of ``config.records`` episodes, or, if these are none, plays
    episodes itself.

    Args:
        name: the trainer's.
        config: its Config.
        game: what is played.
        episode: seed of the first episode.
    """
    cls, source = TRAINERS.resolve(name), game.source
    given: dict[str, Any] = {"game": game, "episode": episode}
    if config.records:
        given = {"record": game.record(range(episode, episode + config.records))}
    return cls(source.system, config, noise_std=source.setup.noise_std, **given)


def train_by_name(
    name: str, config: TrainingConfig, game: Game, episode: int = TRAINING_SEED, **options: Any
) -> Trained:
    """What the trainer of that name makes of a config on a game; see `trainer_of`.

    Args:
        name: the trainer's.
        config: its Config.
        game: what is played.
        episode: seed of the first episode.
        options: ``log``, ``checkpoint``, ``resume`` and ``progress`` of `train`.
    """
    return train(trainer_of(name, config, game, episode), **options)


def load(cls: type[BaseEstimator], path: Path, game: Game) -> BaseEstimator:
    """The trained estimator in a file, given the noise of the game's setup if it makes use of it.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another system.
    """
    if not issubclass(cls, LearnedEstimator):
        name = getattr(cls, "name", cls.__name__)
        raise ValueError(f"estimator {name!r} is not one that is trained first")
    estimator: Any = cls.load(path, game.source.system)
    noise_std = game.source.setup.noise_std
    return replace(estimator, noise_std=noise_std) if "noise" in cls.knows else estimator
