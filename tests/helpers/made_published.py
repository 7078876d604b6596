"""A small leaderboard, and its results packed as published ones."""

from pathlib import Path
from typing import NamedTuple

from pinnobs_gym.envs.game import Game
from pinnobs_gym.leaderboard.jobs import plan
from pinnobs_gym.leaderboard.jobs.job import Job, run_job
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.packing import pack
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.floor import run_floor

KKL = {"trajectories": 40, "samples": 20, "iterations": 4, "width": 6, "patience": 1.0}
NETWORK = {"depth": 2, "width": 8, "iterations": 3}
SUITE = Suite(
    systems=("ReverseDuffing",),
    estimators=(
        Entry("ekf"),
        Entry("open_loop"),
        Entry("kkl_supervised", settings=KKL),
        Entry("pinn_obs", settings=NETWORK),
    ),
    conditions=("nominal",),
    episodes=4,
    trained_episodes=1,
    training_seeds=(0, 1),
)


class Made(NamedTuple):
    """A leaderboard that was played and packed."""

    jobs: list[Job]
    rows: Path
    """Its rows file."""
    folder: Path
    """The folder of the published results."""
    manifest: Manifest


def make(folder):
    """Play the suite in a folder, and pack it into another one."""
    jobs = plan.jobs_of(SUITE, folder / "run")
    for job in jobs:
        run_job(job)
    path = folder / "run" / "rows.jsonl"
    run_floor(Game.of("ReverseDuffing"), range(2), path)
    packed = pack(jobs, rows.load(path), folder / "published", SUITE.training_seeds)
    return Made(jobs, path, folder / "published", packed)
