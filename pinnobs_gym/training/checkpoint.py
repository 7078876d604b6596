"""Checkpoints: files from which a training is resumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym.estimation.hints import check_field
from pinnobs_gym.estimation.learned.trained_file import (
    check_same,
    identity,
    plain,
    read,
    with_arrays,
    with_tensors,
    write,
)
from pinnobs_gym.training.settings import ALWAYS_MAY_CHANGE
from pinnobs_gym.training.trainer import Trainer


def save_checkpoint(trainer: Trainer[Any, Any], path: Path) -> None:
    """Write a checkpoint from which `load_checkpoint` resumes the training exactly.

    Raises:
        ValueError: in one line, if the file cannot be written.
    """
    content = {
        "checkpoint": _identity(trainer),
        "record": _record(trainer),
        "iteration": trainer.iteration,
        "seconds": trainer.seconds,
        "state": trainer.state(),
    }
    write(path, with_tensors(content))


def load_checkpoint(trainer: Trainer[Any, Any], path: Path) -> None:
    """Restore a checkpoint into a new trainer.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another training.
    """
    saved = with_arrays(read(path))
    try:
        check_same(path, saved["checkpoint"], _identity(trainer))
        for name, array in _record(trainer).items():
            if not np.array_equal(saved["record"][name], array, equal_nan=True):
                raise ValueError(f"{path} was trained on another record: its {name} differs")
        try:
            check_field("iteration", saved["iteration"], int)
            check_field("seconds", saved["seconds"], float)
            trainer.continue_from(saved["iteration"], saved["seconds"])
            trainer.load_state(saved["state"])
        except ValueError as error:
            raise TypeError(error) from None
    except (KeyError, TypeError, AttributeError, RuntimeError, IndexError) as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{path} is not a checkpoint of this trainer: {reason}") from None


def _identity(trainer: Trainer[Any, Any]) -> dict[str, Any]:
    """Return the facts that a checkpoint and the resuming trainer must agree on."""
    free = (*ALWAYS_MAY_CHANGE, *trainer.config.may_change)
    config = {name: v for name, v in asdict(trainer.config).items() if name not in free}
    facts = {**identity(trainer.system), "trainer": trainer.name}
    if not trainer.has_record:
        facts |= {"game": trainer.game.name._asdict(), "episode": trainer.episode}
    noise = {"noise_std": trainer.noise.output, "process_noise": trainer.noise.process}
    levels = {name: level.tolist() for name, level in noise.items()}
    return {**facts, **levels, "config": plain(config)}


def _record(trainer: Trainer[Any, Any]) -> Mapping[str, np.ndarray]:
    """Return the arrays of the record by name; none if the trainer plays episodes itself."""
    if not trainer.has_record:
        return {}
    record = trainer.record
    prior = {"xhat0": record.prior.mean, "P0": record.prior.cov}
    arrays = {"t": record.t, "y": record.y, "u": record.u, **prior}
    return arrays if record.noise_std is None else {**arrays, "noise_std": record.noise_std}
