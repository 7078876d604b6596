"""Damaged suites."""

from __future__ import annotations

from collections.abc import Iterator
from random import Random

from hardening.material import SYSTEM, Material
from hardening.mutations import TEXT, mutated
from hardening.trial import Trial, call, written
from pinnobs_gym.cli.commands.leaderboard import Leaderboard

MOST = 200
GOOD = f"""\
systems = ["{SYSTEM}"]
estimators = ["ekf", {{ name = "ekf", label = "gated", settings = {{ gate = 0.99 }} }}]
conditions = ["nominal", "noise5"]
episodes = 2
seed = 3
training_seeds = [0, 1]
budgets = [1.5]
"""
VALUES = (
    "0",
    "-1",
    "nan",
    "inf",
    "1e400",
    "true",
    '"x"',
    "[]",
    "{}",
    "[[]]",
    "''",
    '"\\u001b"',
    "2026-01-01",
)
VALUES += ("9" * 5000, "0x10", "1_0", "[1]", '["x"]', '["ekf", "ekf"]', "[{ name = 1 }]", "[nan]")
VALUES += (
    '[{ name = "ekf", settings = { gate = "x" } }]',
    "[" * 3000 + "]" * 3000,
    "[-1]",
    "[0.0]",
)


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield plans of damaged suites: of changed text, and of one changed value."""
    path = material.file("damaged.toml")

    def planned(data: bytes) -> None:
        written(path, data)
        if len(Leaderboard(suite=str(path), out=material.file("out")).planned()) > 10**6:
            raise ValueError(f"{path}: too many jobs")

    lines = GOOD.splitlines(keepends=True)
    while True:
        if rng.random() < 0.5:
            what, data = mutated(rng, GOOD.encode(), TEXT)
        else:
            i, value = rng.randrange(len(lines)), rng.choice(VALUES)
            key = lines[i].partition(" ")[0]
            what = f"{key} = {value[:40]}"
            data = "".join([*lines[:i], f"{key} = {value}\n", *lines[i + 1 :]]).encode()
        yield call(f"suite: {what}", lambda d=data: planned(d), [str(path)])
