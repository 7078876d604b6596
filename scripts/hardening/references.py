"""Damaged reference states of a log."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.material import Material
from hardening.mutations import TEXT, mutated
from hardening.trial import Trial, call, written
from pinnobs_gym.scoring.log_game import LogGame

MOST = 150


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield logs that are to be scored against a damaged reference."""
    path, log = material.file("reference.csv"), material.log_file
    source = material.game.source

    def read(data: bytes) -> None:
        written(path, data)
        LogGame.of(source.system, source.setup, (log,), (path,), ())

    while True:
        what, data = mutated(rng, material.reference, TEXT)
        yield call(f"reference: {what}", lambda d=data: read(d), [str(path)])
