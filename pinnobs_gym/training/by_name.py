"""Training by the name of a trainer, and loading what it made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from pinnobs_gym.envs.registration import make_vector_env, record_of
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.registry import trainer
from pinnobs_gym.simulation.system import Setup, System

TRAINING_SEED = 10**6
"""Seed of the first episode that an estimator trained beforehand learns from; further ones have the
seeds after it, as many as its trainer's Config says (``episodes``). None is scored on them."""


class Played(NamedTuple):
    """The episodes of an env: what is played, and from which seed on."""

    env_id: str
    setup: str
    condition: str
    seed: int


def train(name: str, config: Any, played: Played, **options: Any) -> Any:
    """What the trainer of that name makes of a config: an object with `save`.

    A trainer learns from the record of ``config.episodes`` episodes and is given it, with the noise
    that the setup tells; or, if these are none, it plays episodes itself and is told of which env.

    Args:
        name: the trainer's.
        config: its Config.
        played: the episodes, or the first of them.
        options: ``log``, ``checkpoint``, ``resume`` and ``progress``, as the trainer takes them.
    """
    module = trainer(name)
    if not config.episodes:
        system = make_vector_env(played.env_id, 1, played.setup, played.condition).source.system
        return module.train(system, config, played=played, **options)
    system, setup, record = record_of(*played, config.episodes)
    return module.train(system, config, record=record, noise_std=setup.noise_std, **options)


def load(cls: type[Estimator], path: Path, system: System, setup: Setup) -> Estimator:
    """The trained estimator in a file, told what a setup says of the noise.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another system.
    """
    if cls.needs_training is None:
        raise ValueError(f"estimator {cls.__name__!r} is not one that is trained first")
    trained_cls: Any = cls
    estimator = trained_cls.load(path, system)
    return replace(estimator, noise_std=setup.noise_std) if "noise" in cls.knows else estimator
