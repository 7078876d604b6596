"""Damaged estimates that were made elsewhere, and damaged facts of their records."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.material import Material
from hardening.mutations import TEXT, mutated
from hardening.trial import Trial, call, written
from pinnobs_gym.scoring.episode_folder import read_folder
from pinnobs_gym.scoring.submitted import read_estimates

MOST = 200


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield damaged estimates, and records with a damaged ``game.json``."""
    path, facts = material.file("estimates.csv"), material.records / "game.json"
    right = facts.read_bytes()
    game, seeds = read_folder(material.records)

    def read(data: bytes) -> None:
        read_estimates(written(path, data), game, seeds)

    def read_facts(data: bytes) -> None:
        try:
            written(facts, data)
            read_folder(material.records)
        finally:
            written(facts, right)

    while True:
        if rng.random() < 0.7:
            what, data = mutated(rng, material.estimates, TEXT)
            yield call(f"estimates: {what}", lambda d=data: read(d), [str(path)])
        else:
            what, data = mutated(rng, right, TEXT)
            yield call(f"game.json: {what}", lambda d=data: read_facts(d), [str(facts)])
