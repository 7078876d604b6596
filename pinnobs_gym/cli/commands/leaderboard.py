"""`leaderboard ...`: run every estimator on every system."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pinnobs_gym.cli.board_report import report, say_outdated
from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.run_view import Kind, RunView
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard import suites
from pinnobs_gym.leaderboard.jobs import plan
from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.jobs.job import Job
from pinnobs_gym.leaderboard.jobs.stopping import stoppable
from pinnobs_gym.leaderboard.jobs.trainings import Outlook, training_of
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.reading import published_floors
from pinnobs_gym.scoring import rows, tensorboard

PROCESSES = 2
"""Default number of processes."""


@dataclass(frozen=True)
class Leaderboard:
    """Run every estimator on every system and print the tables; stored results are kept."""

    suite: str = "leaderboard"
    """Suite to play: full, leaderboard, paper, quick, or the path of your own TOML file. The
    options from systems to seed override it."""
    systems: tuple[str, ...] = ()
    """Names or module:Class of systems."""
    estimators: tuple[str, ...] = ()
    """Names or module:Class of estimators; "ekf, tuned" is the EKF with its stored settings."""
    setup: str | None = None
    """Setup to play."""
    condition: tuple[str, ...] = ()
    """Conditions; by default those of the suite or, if it names none, nominal and the system's
    ranked condition. With "all", estimators that need no training play every condition that applies
    to the system."""
    episodes: int | None = None
    """Episodes of each estimator and system."""
    trained_episodes: int | None = None
    """Episodes of estimators that train on every record."""
    budget: tuple[float, ...] = ()
    """CPU seconds of each training; each of several is a separate training."""
    training_seeds: tuple[int, ...] = ()
    """Seeds of each training."""
    seed: int | None = None
    """Seed of the first episode."""
    jobs: int | None = None
    """Number of processes on this machine, one thread each; 2 if not given. With 1, jobs run in the
    process of the command, unless a time limit is given."""
    timeout: float | None = None
    """Time limit of each job in s of wall-clock time; a job that exceeds it is ended and has
    failed. If not given, two hours and four times the budget; none with 1 process."""
    backend: Literal["loky", "dask"] = "loky"
    """Where jobs run: processes of this machine, or the workers of a Dask scheduler, which needs
    the extra "dask"."""
    scheduler: str | None = None
    """Address of the Dask scheduler, such as tcp://host:8786."""
    retry_failed: bool = False
    """Run jobs again that failed before; otherwise they are left out."""
    fresh: bool = False
    """Run all episodes, also those whose scores are stored; the new scores replace them. Trained
    files are kept."""
    retrain: bool = False
    """Train all estimators here; otherwise the trained files that ship with the package are used
    where there is one of the same settings."""
    out: Path = Path("runs/leaderboard")
    """Folder of rows, tables, TensorBoard log and trained files."""

    def run(self) -> int:
        """Run the missing jobs, then print and write the tables."""
        return self.play(self.planned())

    def play(self, planned: Sequence[Job]) -> int:
        """Run those of the jobs that are missing, then print and write the tables; return the exit
        status."""
        workers = self._workers()
        check_writable(self.out)
        path = self.out / "rows.jsonl"
        stored = rows.load(path)  # reject a damaged file before anything is run
        if stored.warning:
            console.print(stored.warning, style="yellow", soft_wrap=True)
        games = {job.game.name for job in planned} | {rows.game_of(row) for row in stored.rows}
        shipped = published_floors(games)  # reject what is damaged there, too
        jobs = [replace(job, fresh=self.fresh) for job in planned]
        to_run, left_out = plan.left(jobs, stored, self.retry_failed)
        earlier = {rows.key(row): row["date"] for row in stored.rows}
        outlook = Outlook()
        outdated = outlook.outdated(jobs)
        engine = Engine(workers)
        kinds = {_key(job): kind_of(job, outlook) for job in to_run}
        with (
            stoppable(),
            RunView(list(kinds.values()), engine) as view,
            closing(engine.run(to_run)) as ended,
        ):
            for job, error, seconds in ended:
                view.ended(job.name, kinds[_key(job)], error, seconds)
        begun = time.monotonic()
        stored = rows.load(path)
        self._say_reuse(to_run, view.failed, earlier, stored)
        tensorboard.log_summaries(self.out, stored.rows)
        report(stored, shipped, {job.game.name.condition for job in jobs}, self.out)
        parts = {**view.seconds(), "tables": time.monotonic() - begun}
        times = ", ".join(f"{part} {seconds:.0f} s" for part, seconds in parts.items())
        console.print(f"{'time:':14} {times}", soft_wrap=True, highlight=False)
        say_outdated(outdated)
        if left_out:
            console.print(
                f"{len(left_out)} job(s) failed before and were left out; --retry-failed runs "
                "them again",
                style="yellow",
                soft_wrap=True,
            )
        print_next("report", path, "-o", self.out / "site")
        return 1 if view.failed or left_out else 0

    def planned(self) -> list[Job]:
        """Return the jobs of the suite with the options."""
        suite = self._suite()
        published = None if self.retrain else manifest.FOLDER
        jobs = plan.jobs_of(suite, self.out.absolute())
        return [replace(job, published=published) for job in jobs]

    def _suite(self) -> suites.Suite:
        return suites.load(self.suite).changed(
            systems=self.systems,
            estimators=self.estimators,
            setup=self.setup,
            conditions=self.condition,
            episodes=self.episodes,
            trained_episodes=self.trained_episodes,
            budgets=self.budget,
            training_seeds=self.training_seeds,
            seed=self.seed,
            timeout=self.timeout,
        )

    def _say_reuse(
        self,
        jobs: Sequence[Job],
        failed: int,
        earlier: Mapping[tuple[Any, ...], str],
        stored: rows.Stored,
    ) -> None:
        """Print how many episodes were taken from the rows file, if any were."""
        asked = sum(job.episodes for job in jobs)
        played = sum(earlier.get(rows.key(row)) != row["date"] for row in stored.rows)
        if not failed and played < asked:
            console.print(
                f"{asked - played} of {asked} episodes taken from {self.out / 'rows.jsonl'}",
                soft_wrap=True,
                highlight=False,
            )

    def _workers(self) -> Workers:
        if self.backend == "dask":
            if self.scheduler is None:
                raise ValueError("backend 'dask' without a scheduler; expected --scheduler ADDRESS")
            if self.jobs is not None:
                message = "the scheduler's workers say how many run at a time"
                raise ValueError(f"jobs={self.jobs} with backend 'dask': {message}")
            return Workers(scheduler=self.scheduler)
        if self.scheduler is not None:
            raise ValueError(f"scheduler={self.scheduler!r} goes with --backend dask")
        if self.jobs is not None and self.jobs < 1:
            raise ValueError(f"jobs={self.jobs}; expected at least 1")
        return Workers(self.jobs or PROCESSES, apart=self._suite().timeout is not None)


def _key(job: Job) -> tuple[str, str]:
    """Return what tells a job from all others of a run."""
    return job.name, repr(job.training)


def kind_of(job: Job, outlook: Outlook) -> Kind:
    """Return what a job mostly does, and the name that it shares with jobs that take as long."""
    # Some of the known keys may be of other code; then the job takes longer than estimated.
    training = training_of(job)
    seed = None if training is None else training.recipe.seed
    known = {episode for _, _, trained, episode in job.known or () if trained == seed}
    if len(known) >= job.episodes and not job.fresh:
        return Kind("playing", f"{job.called}, stored")
    return Kind("trainings" if outlook.will_train(job) else "playing", job.called)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Leaderboard, "leaderboard", arguments).run()
