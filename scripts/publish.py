"""Play the published leaderboard and pack its results into the package.

Every training is done for five seeds, those on single records for one. The floor of errors is
computed where there is one. A run that is stopped goes on where it ended, and a run of which
everything is stored only packs.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.cli import guarded
from pinnobs_gym.cli.commands.floor import compute
from pinnobs_gym.cli.commands.leaderboard import PROCESSES, Leaderboard
from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse
from pinnobs_gym.envs.game import Game
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.jobs.floor_job import FloorJob, floor_jobs, left
from pinnobs_gym.leaderboard.jobs.job import Job
from pinnobs_gym.leaderboard.jobs.trainings import training_of
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.packing import pack
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.floor import LARGEST
from pinnobs_gym.systems import SYSTEMS

FLOOR_CONDITIONS = ("nominal", "noise5", "dropout30")
"""Conditions whose floors are published."""


@dataclass(frozen=True)
class Publish:
    """Play a suite with all training seeds, and pack its rows and trained files."""

    suite: str = "leaderboard"
    """Suite to play."""
    training_seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of each training; the trained files of the first are published."""
    jobs: int | None = None
    """Number of processes; 2 if not given."""
    out: Path = Path("runs/publish")
    """Folder of the leaderboard."""
    to: Path = manifest.FOLDER
    """Folder of the published results."""

    def run(self) -> int:
        """Play what is missing, and pack."""
        check_writable(self.to)
        leaderboard = Leaderboard(
            suite=self.suite,
            training_seeds=self.training_seeds,
            jobs=self.jobs,
            retrain=True,
            out=self.out,
        )
        jobs = [job for job in leaderboard.planned() if self._is_wanted(job)]
        floors = left(self._floors(jobs), rows.load(self.out / "rows.jsonl"))
        failed = compute(floors, leaderboard.jobs or PROCESSES)
        status = 1 if failed else leaderboard.play(jobs)
        if status:
            console.print("nothing is published: not all jobs are done", style="red")
            return status
        stored = rows.load(self.out / "rows.jsonl")
        packed = pack(jobs, stored, self.to, self.training_seeds)
        size = sum(file.size for file in (*packed.rows, *packed.trained, *packed.curves))
        console.print(
            f"published: {sum(entry.rows for entry in packed.rows)} rows of {len(packed.rows)} "
            f"games and {len(packed.trained)} trained files, {size / 1e6:.2f} MB, in {self.to}",
            soft_wrap=True,
            highlight=False,
        )
        return 0

    def _is_wanted(self, job: Job) -> bool:
        """Return whether a job is played: trainings on single records for the first seed only."""
        training = training_of(job)
        if training is None or training.seed is None:
            return True
        return training.recipe.seed == self.training_seeds[0]

    def _floors(self, jobs: Sequence[Job]) -> list[FloorJob]:
        """Return the jobs of the floors of the systems that are played, where there is one, under
        `FLOOR_CONDITIONS`."""
        seeds = {job.game.system: range(job.seed, job.seed + job.episodes) for job in jobs}
        found: list[FloorJob] = []
        for system, own in seeds.items():
            if len(SYSTEMS.resolve(system).state_names) > LARGEST:
                continue
            games = [Game.of(system, condition=condition) for condition in FLOOR_CONDITIONS]
            found += floor_jobs(games, own, self.out.absolute(), fresh=False)
        return found


if __name__ == "__main__":
    sys.exit(guarded(lambda: parse(Publish, "publish", sys.argv[1:]).run()))
