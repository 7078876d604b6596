"""What the command ``train`` learns from: simulated episodes, or sensor logs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import Game
from pinnobs_gym.files import file_name
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.together import together
from pinnobs_gym.simulation.system import Setup
from pinnobs_gym.training.by_name import LOGS, trainer_of, trainer_on_logs
from pinnobs_gym.training.settings import TrainingConfig
from pinnobs_gym.training.trainer import Trainer, first_episode


@dataclass(frozen=True)
class Task:
    """What a training learns from."""

    stem: Path
    """The files of the training, without their suffixes."""
    make: Callable[[], Trainer[Any, Any]]
    """Makes the trainer."""
    game: Game | None = None
    """The game whose episodes are learned from; None of logs, whose states are not known, so that
    nothing is scored after the training."""
    episode: int = 0
    """Seed of its first episode."""

    def file(self, suffix: str) -> Path:
        """Return a file of the training."""
        return self.stem.with_name(self.stem.name + suffix)


def on_episodes(
    cls: type[Trainer[Any, Any]], config: TrainingConfig, game: Game, first: int | None, out: Path
) -> Task:
    """Return a training on simulated episodes.

    Args:
        cls: the trainer.
        config: its settings.
        game: the episodes.
        first: seed of the first episode; `first_episode` of the training seed if None.
        out: folder of the files.
    """
    seed = config.seed
    episode = first_episode(seed) if first is None else first
    name = f"{game.name.file_stem}-{file_name(cls.name)}-episode{episode}-seed{seed}"
    make = partial(trainer_of, cls, config, game, episode)
    return Task(out / name, make, game, episode)


def on_logs(
    cls: type[Trainer[Any, Any]],
    config: TrainingConfig,
    setup: Setup,
    logs: Sequence[Log],
    out: Path,
) -> Task:
    """Return a training on sensor logs, whose files are named after the first of them.

    Args:
        cls: the trainer.
        config: its settings.
        setup: the noise.
        logs: the logs, at least one, with the same sample times.
        out: folder of the files.

    Raises:
        ValueError: in one line, if sample times differ.
    """
    system, record = together(logs)
    more = f"+{len(logs) - 1}" if len(logs) > 1 else ""
    parts = type(system).__name__, LOGS, logs[0].path.stem + more, cls.name
    name = f"{'-'.join(map(file_name, parts))}-seed{config.seed}"
    return Task(out / name, partial(trainer_on_logs, cls, config, system, setup, record))
