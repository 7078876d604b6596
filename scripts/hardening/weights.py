"""Damaged files of trained weights."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.files import damaged
from hardening.material import Material, digest
from hardening.trial import Trial
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.training.by_name import load

MOST = 200


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield files of weights, which are refused or give the estimates of the undamaged one."""
    path, cls = material.file("trained.pt"), ESTIMATORS.resolve("pinn_gain")

    def read() -> str:
        return digest(load(cls, path, material.game).run(material.record).xhat)

    yield from damaged(rng, path, material.trained, read)
