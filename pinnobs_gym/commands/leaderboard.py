"""`leaderboard ...`: run every estimator on every system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym import leaderboard, overview, rows, suite
from pinnobs_gym.console import console, print_grid, print_table, progress
from pinnobs_gym.options import parse
from pinnobs_gym.report import check_writable, replacing
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class Leaderboard:
    """Run every estimator on every system and print the tables; what is already there is kept."""

    systems: tuple[str, ...] = ()
    """Names or module:Class of systems; all that are known if empty."""
    estimators: tuple[str, ...] = ()
    """Names or module:Class of estimators; all that are known if empty."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: tuple[str, ...] = ()
    """Conditions; nominal, and the one that a system is ranked under, if none is given. With "all",
    those that need no training play every condition that fits the system as well."""
    episodes: int = 100
    """Episodes of each estimator and system."""
    trained_episodes: int = 5
    """Episodes of those that train on every record."""
    budget: float = 45.0
    """CPU seconds of each training."""
    seed: int = 0
    """Seed of the first episode."""
    jobs: int = 2
    """Processes at a time, one thread each."""
    out: Path = Path("runs/leaderboard")
    """Folder of rows, tables, TensorBoard log and trained files."""

    def run(self) -> int:
        """Run what is missing, then print and write the tables."""
        for name, least in (("jobs", 1), ("episodes", 1), ("trained_episodes", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name}={getattr(self, name)}; expected at least {least}")
        if not self.budget > 0:
            raise ValueError(f"budget={self.budget}; expected a positive number of seconds")
        check_writable(self.out)
        rows.read(self.out / "rows.jsonl")  # a damaged file is refused before anything is run
        jobs = suite.jobs_of(
            self.systems or tuple(SYSTEMS.classes()),
            self.estimators or suite.default_estimators(),
            setup=self.setup,
            conditions=self.condition,
            episodes=self.episodes,
            trained_episodes=self.trained_episodes,
            seed=self.seed,
            folder=self.out,
            training={"budget": self.budget},
        )
        failures = []
        with progress() as bar:
            task = bar.add_task("jobs", total=len(jobs))
            for job, failure in suite.run_jobs(jobs, self.jobs):
                bar.advance(task)
                if failure is not None:
                    failures.append(f"failed: {job.name}: {failure}")
                    bar.console.print(failures[-1], markup=False)
        scored = rows.read(self.out / "rows.jsonl")
        suite.log_summaries(self.out, scored)
        tables = leaderboard.tables(scored)
        played = {job.condition for job in jobs}
        shown = [table for table in tables if table.condition in played]
        for table in shown if len(played) <= 2 else ():
            print_table(table)
        console.print(leaderboard.NOTE if len(played) <= 2 else "")
        print_grid("Across systems", *overview.cells(overview.lines(scored)))
        console.print(overview.NOTE)
        placed = overview.ranks(scored)
        if len(placed) > 1:
            print_grid("Ranks", *overview.rank_cells(placed))
            console.print(overview.RANK_NOTE)
        path = self.out / "leaderboard.md"
        with replacing(path) as temporary:
            text = overview.markdown(scored) + "\n" + leaderboard.markdown(tables)
            temporary.write_text(text, encoding="utf-8")
        for what, where in (
            ("tables", path),
            ("rows", self.out / "rows.jsonl"),
            ("TensorBoard", self.out / "tensorboard"),
            ("trained files", self.out / "trained"),
        ):
            if where.exists():
                console.print(f"{what + ':':14} {where}", soft_wrap=True)
        console.print(
            f"to make a page: pinnobs report {self.out / 'rows.jsonl'} -o {self.out / 'site'}",
            soft_wrap=True,
        )
        return 1 if failures else 0


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns its exit status."""
    return parse(Leaderboard, "leaderboard", arguments).run()
