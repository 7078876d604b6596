"""Training by the name of a trainer, and loading what it made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.registry import trainer

TRAINING_SEED = 10**6
"""Seed of the first episode that an estimator trained beforehand learns from; further ones have the
seeds after it, as many as its trainer's Config says (``episodes``). None is scored on them."""


def train(name: str, config: Any, game: Game, seed: int = TRAINING_SEED, **options: Any) -> Any:
    """What the trainer of that name makes of a config: an object with `save`.

    A trainer learns from the record of ``config.episodes`` episodes and is given it, with the noise
    that the setup tells; or, if these are none, it plays episodes itself and is told of which game.

    Args:
        name: the trainer's.
        config: its Config.
        game: what is played.
        seed: of the first episode.
        options: ``log``, ``checkpoint``, ``resume`` and ``progress``, as the trainer takes them.
    """
    module, source = trainer(name), game.source
    if not config.episodes:
        return module.train(source.system, config, game=game, seed=seed, **options)
    record = game.record(range(seed, seed + config.episodes))
    noise_std = source.setup.noise_std
    return module.train(source.system, config, record=record, noise_std=noise_std, **options)


def load(cls: type[Estimator], path: Path, game: Game) -> Estimator:
    """The trained estimator in a file, told what the game's setup says of the noise.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another system.
    """
    if cls.needs_training is None:
        raise ValueError(f"estimator {cls.__name__!r} is not one that is trained first")
    trained_cls: Any = cls
    estimator = trained_cls.load(path, game.source.system)
    told = game.source.setup.noise_std
    return replace(estimator, noise_std=told) if "noise" in cls.knows else estimator
