"""Damaged files of curves."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.files import damaged
from hardening.material import Material, digest
from hardening.trial import Trial
from pinnobs_gym.scoring import curves

MOST = 200


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield curves, which are refused or are those of the undamaged file."""
    good = next(curves.folder_of(material.rows_file).rglob("*.npz"))
    folder = material.file("curves")
    path = folder / good.relative_to(curves.folder_of(material.rows_file))
    path.parent.mkdir(parents=True, exist_ok=True)

    def read() -> str:
        found = curves.read(folder, material.game.name)
        return digest(
            [[vars(part), vars(part.example)] for parts in found.values() for part in parts]
        )

    yield from damaged(rng, path, good.read_bytes(), read)
