"""The engine and the tables at scale: overhead of a job, two processes over one, 100,000 rows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks import Figure, at_least, at_most
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import markdown
from pinnobs_gym.leaderboard.jobs import plan
from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.metrics import DIVERGED, OPTIONAL_SCORES, SCORES
from pinnobs_gym.systems import SYSTEMS

JOBS = 2000
ROWS = 100_000
CONDITIONS = ("nominal", "load_step", "noise5", "mismatch10", "outliers", "dropout30", "dt2")
EPISODES = 120


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the engine and the tables."""
    yield from overhead("loky", Workers(2), 5.0)
    with cluster() as address:
        yield from overhead("Dask", Workers(scheduler=address), 20.0)
    yield two_over_one(min(repeats, 3))
    yield from many_rows()


def synthetic_rows(count: int, seed: int = 0) -> list[rows.Row]:
    """Return ``count`` rows of a leaderboard with synthetic scores.

    There are `EPISODES` rows for each estimator, system and condition; if these are too few, they
    are repeated with further training seeds.
    """
    rng = np.random.default_rng(seed)
    names = sorted(set(ESTIMATORS.classes()) - {"ekf"})
    systems = [cls for name, cls in SYSTEMS.classes().items() if cls.__module__.startswith("pinn")]
    games = product(CONDITIONS, systems, ["ekf", *names])
    made: list[rows.Row] = []
    for condition, cls, name in games:
        model, _ = cls.configured()
        estimator = ESTIMATORS.classes()[name]
        learns = estimator.needs_training or estimator.trains_on_record
        base = {
            "schema": rows.SCHEMA,
            "kind": "score",
            "env_id": f"pinnobs/{cls.__name__}-v0",
            "setup": "benchmark",
            "condition": condition,
            "ranked": condition == cls.ranked_condition,
            "nx": model.nx,
            "estimator": name,
            "track": estimator.track,
            "knows": list(estimator.knows),
            "options": {},
            "settings": {},
            "game_hash": "0" * 12,
            "estimator_code": name,
            "estimator_hash": f"{abs(hash((name, cls.__name__))):012x}"[:12],
            "training": {"seed": 0, "seconds": 45.0, "config": {"budget": 45.0}} if learns else {},
            "training_seed": 0 if learns else None,
            "versions": {"python": "3.13.0", "pinnobs-gym": "0.1.0", "numpy": "2.4.0"},
            "date": "2026-01-01T00:00:00.000+00:00",
            "batch": EPISODES,
        }
        level = rng.lognormal(-3, 1)
        for episode in range(min(EPISODES, count - len(made))):
            score = float(level * rng.lognormal(0, 0.4))
            row = base | dict.fromkeys(SCORES, score) | dict.fromkeys(OPTIONAL_SCORES)
            row |= {"nrmse_steady": score / 10, "nrmse_steady_modulo": score / 10, "settling": 1.0}
            row |= {"nrmse_tail": score / 10}
            row |= {"state_rmse": {}, "free_over_known": None, "nominal_over_free": None}
            row |= {"anees": 1.0, "coverage": 0.9, "reference_steady": 0.03}
            made.append(
                row
                | {
                    "diverged": score / 10 > DIVERGED,
                    "episode": f"seed:{episode}",
                    "us_per_step": float(level),
                }
            )
        if len(made) == count:
            return made
    seeds = range(1, 1 + count // len(made))  # training seeds
    return (made + [row | {"training_seed": s} for s in seeds for row in made])[:count]


@dataclass(frozen=True)
class Trivial:
    """A job that only appends a row."""

    folder: Path
    row: rows.Row

    @property
    def name(self) -> str:
        """Name of the job."""
        return "trivial"

    @property
    def time_limit(self) -> None:
        """It needs no limit."""

    def run(self) -> None:
        """Append the row."""
        rows.append(self.folder / "rows.jsonl", [self.row])

    def anew(self) -> Trivial:
        """Return the job itself."""
        return self

    def fail(self, error: str) -> None:
        """Raise an error; this job never fails."""
        raise AssertionError(error)


def overhead(name: str, workers: Workers, bound: float) -> Iterator[Figure]:
    """Measure the wall time per job of `JOBS` jobs that each append a row.

    It is measured once all workers are running, and including their start.
    """
    with tempfile.TemporaryDirectory() as folder:
        jobs = [Trivial(Path(folder), row) for row in synthetic_rows(JOBS)]
        start = time.perf_counter()
        times = [time.perf_counter() for _ in Engine(workers).run(jobs)]
        assert len(rows.read(Path(folder) / "rows.jsonl")) == JOBS
    first = 50  # by then both workers have imported all modules
    steady = 1000 * (times[-1] - times[first]) / (JOBS - 1 - first)
    yield at_most(f"overhead of a job, two workers of {name}", steady, "ms", bound)
    whole = 1000 * (times[-1] - start) / JOBS
    yield Figure(f"the same, {name}'s start included", whole, "ms", "", None)


@contextmanager
def cluster() -> Iterator[str]:
    """Start a local Dask scheduler with two workers, and yield its address."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "scheduler.json"
        local = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}

        def start(program: str, *arguments: object) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", f"distributed.cli.{program}", *map(str, arguments)]
            return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)

        processes = [start("dask_scheduler", *local, "--scheduler-file", file)]
        try:
            while not (file.exists() and file.read_text()):
                time.sleep(0.1)
            address = json.loads(file.read_text())["address"]
            one = (address, "--nthreads", 1, "--no-dashboard", "--no-nanny")
            processes += [start("dask_worker", *one) for _ in range(2)]
            yield address
        finally:
            for process in reversed(processes):
                process.terminate()
                process.wait()


def two_over_one(repeats: int) -> Figure:
    """Measure the ratio of wall times with one process and with two.

    The suite is the EKF on every system under some conditions; the processes are warmed up by one
    run of the suite.
    """
    played = ("nominal", "noise5", "outliers", "dropout30", "gap")
    suite = Suite(estimators=(Entry("ekf"),), conditions=played)

    def seconds(processes: int) -> float:
        with tempfile.TemporaryDirectory() as folder:
            jobs = plan.jobs_of(suite, Path(folder))
            start = time.perf_counter()
            for job, error, _ in Engine(Workers(processes)).run(jobs):
                assert error is None, (job, error)
            return time.perf_counter() - start

    seconds(2)
    ratios = [seconds(1) / seconds(2) for _ in range(repeats)]
    label = "EKF suite: throughput of two processes over one"
    return at_least(label, float(np.median(ratios)), "", 1.8)


def many_rows() -> Iterator[Figure]:
    """Measure the seconds from a file of rows to all tables."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rows.jsonl"
        rows.append(path, synthetic_rows(ROWS))
        start = time.perf_counter()
        stored = rows.load(path)
        read = time.perf_counter()
        markdown(board(stored))
        end = time.perf_counter()
    yield at_most(f"{ROWS:,} rows read", read - start, "s", 4)
    yield at_most(f"{ROWS:,} rows read, and all tables", end - start, "s", 4)
