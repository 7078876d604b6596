"""Damaged files of live filters."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.files import damaged
from hardening.material import Material, digest
from hardening.trial import Trial
from pinnobs_gym.estimation.live import Live

MOST = 200


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield live filters, which are refused or go on as the undamaged one."""
    path, record = material.file("damaged.live"), material.record

    def read() -> str:
        live = Live.load(path, material.filter)
        estimate = live.update(record.t[5], record.y[0, 5])
        return digest([estimate.xhat, estimate.std])

    yield from damaged(rng, path, material.live, read)
