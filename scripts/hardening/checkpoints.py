"""Damaged checkpoints."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.files import damaged
from hardening.material import Material, digest
from hardening.trial import Trial
from pinnobs_gym.training.checkpoint import load_checkpoint

MOST = 150


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield checkpoints, which are refused or continue as the undamaged one."""
    path, trainer = material.file("damaged.checkpoint.pt"), material.trainer

    def read() -> str:
        load_checkpoint(trainer, path)
        return digest([trainer.iteration, trainer.state()])  # its clock runs on

    yield from damaged(rng, path, material.checkpoint, read)
