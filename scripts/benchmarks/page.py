"""The page of a large leaderboard: how long it takes and how large it is."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from benchmarks import Figure, at_most
from pinnobs_gym.envs.figures import measured_states
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.leaderboard.site.model import page_model
from pinnobs_gym.leaderboard.site.page import draw
from pinnobs_gym.scoring import curves, rows
from pinnobs_gym.scoring.curves import Example
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.provenance import versions
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.scoring.thinning import kept as kept_samples
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.systems import SYSTEMS

ESTIMATORS = 20
CONDITIONS_EACH = 8
EPISODES = 105


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the CPU seconds and MB of the page of 100,000 synthetic rows with their curves."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.jsonl"
        count = _make(path, np.random.default_rng(0))
        start = time.process_time()
        stored = rows.load_all([path])
        reading = time.process_time() - start
        text = draw(page_model(stored, [curves.folder_of(path)]))
        spent = time.process_time() - start
    yield Figure("page: rows", count, "", "", None)
    yield Figure("page: reading the rows, CPU time", reading, "s", "", None)
    yield at_most("page: reading and making it, CPU time", spent, "s", 10.0)
    yield at_most("page: its size", len(text.encode()) / 1e6, "MB", 5.0)


def _make(path: Path, rng: np.random.Generator) -> int:
    """Write the rows and curves of a leaderboard; return the number of rows."""
    count = 0
    for system, cls in SYSTEMS.classes().items():
        own = [cls.ranked_condition, *(c for c in CONDITIONS if c != cls.ranked_condition)]
        for number in range(ESTIMATORS):
            skill = np.exp(rng.normal(0, 0.7))
            for condition in own[:CONDITIONS_EACH]:
                group = _rows(system, number, condition, skill, rng)
                rows.append(path, group)
                count += len(group)
                if group[0]["ranked"] or condition == "nominal":
                    _save_curves(path, group, rng)
    return count


def _rows(
    system: str, number: int, condition: str, skill: float, rng: np.random.Generator
) -> list[Row]:
    """Return the rows of one estimator under one condition."""
    cls = SYSTEMS.resolve(system)
    names = (*SCORES, *OPTIONAL_SCORES)
    values = skill * np.exp(rng.normal(-3, 0.5, (EPISODES, len(names))))
    training = {"seconds": 45.0, "config": {"budget": 45.0}, "seed": 0} if number % 4 == 0 else {}
    common = {
        "schema": rows.SCHEMA,
        "kind": "score",
        "env_id": env_id(system),
        "setup": "benchmark",
        "condition": condition,
        "ranked": condition == cls.ranked_condition,
        "nx": len(cls.state_names),
        "estimator": "ekf" if number == 1 else f"estimator_{number}",
        "track": "offline" if number % 5 == 4 else "online",
        "knows": ["model", "prior", "noise"],
        "options": {"assumed_noise": 3e-3, "gate": None},
        "settings": {},
        "game_hash": "0" * 12,
        "estimator_code": f"{number:012x}",
        "estimator_hash": f"{number:012x}",
        "training": training,
        "training_seed": training.get("seed"),
        "versions": versions(),
        "us_per_step": float(5 * skill),
        "batch": EPISODES,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    diverged = values[:, names.index("nrmse_tail")] > 0.2
    return [
        common
        | dict(zip(names, values[i].tolist(), strict=True))
        | {
            "diverged": bool(diverged[i]),
            "episode": f"seed:{i}",
            "state_rmse": {},
            "free_over_known": None,
            "nominal_over_free": None,
        }
        for i in range(EPISODES)
    ]


def _save_curves(path: Path, group: list[Row], rng: np.random.Generator) -> None:
    system, setup = SYSTEMS.resolve(group[0]["env_id"][8:-3]).configured()
    t = setup.times[:-1]
    error = np.exp(rng.normal(-3, 1, (EPISODES, len(t))))
    x = rng.normal(size=(len(t), system.nx))
    y = rng.normal(size=(len(t), system.ny))
    example = Example(0, t, x, x + 0.1, y, np.full(x.shape, 0.1))
    k = kept_samples(len(t))
    kept = error[:, k].astype(np.float32)
    names, measured = curves.labels(system), measured_states(system)
    own = curves.Curves(t[k], np.arange(EPISODES), kept, kept, example, names, measured)
    curves.save(curves.folder_of(path), group[0], own)
