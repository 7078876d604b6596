"""Reproduce the paper's tables and examples, with the paper's figures beside ours.

    python scripts/reproduce_paper.py depth | activation | weights | examples | comparison

Each case is trained once, even if several tables have it. Existing results are reused; a training
that was stopped, or that gets a larger budget, is resumed from its checkpoint. The output folder
has the results as lines of ``results.jsonl``, a Markdown file per table, and a folder per training
with its figures, TensorBoard log and trained file.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from loky import ProcessPoolExecutor, as_completed
from reproduction import comparison, report
from reproduction.comparison import METHODS, Comparison
from reproduction.running import PaperJob, run
from reproduction.tables import TABLES, Table, recipe
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from pinnobs_gym.cli.console import print_table
from pinnobs_gym.files import append_lines, check_writable, replacing
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.scoring.rows import Row

COMPARISON = "comparison"
"""Name of the table of several methods, which is not in `TABLES`."""

console = Console() if Console().is_terminal else Console(width=150)


@dataclass(frozen=True)
class Options:
    """Reproduce one of the paper's tables, with the paper's figures beside ours."""

    table: Annotated[str, tyro.conf.Positional]
    """depth, activation, weights, examples (the six systems), or comparison (of four methods)."""
    preset: str = "guided"
    """Recipe: guided (fast, guided by a smoother), plain (fast, the paper's loss), or paper."""
    budget: str = "120"
    """CPU seconds of each training; none trains to the recipe's end."""
    seed: int = 0
    """Seed of the initial weights."""
    jobs: int = 2
    """Number of trainings in parallel, one thread each."""
    records: int = 10
    """Number of records of the comparison."""
    only: tuple[str, ...] = ()
    """Names of cases, such as 9x20; all if none is named."""
    out: Path = Path("runs/paper")
    """Folder of the results."""

    def chosen(self) -> list[PaperJob]:
        """Return the jobs of the table.

        Raises:
            ValueError: in one line, if a case is unknown or a setting is not allowed.
        """
        if self.table not in TABLES:
            known = ", ".join([*TABLES, COMPARISON])
            raise ValueError(f"unknown table {self.table!r}; known are {known}")
        cases = {case.name: case for case in TABLES[self.table].cases}
        for name in self.only:
            if name not in cases:
                known = ", ".join(cases)
                raise ValueError(f"unknown case {name!r} of {self.table}; known are {known}")
        if self.jobs < 1:
            raise ValueError(f"jobs={self.jobs}; expected at least 1")
        seed, budget = self.seed, _number(self.budget)
        chosen = [
            (cases[n], recipe(self.preset, cases[n], seed, budget)) for n in self.only or cases
        ]
        return [PaperJob(case, self.preset, config, self.out) for case, config in chosen]

    def compared(self) -> Comparison:
        """Return the comparison.

        Raises:
            ValueError: in one line, if a setting is not allowed.
        """
        if self.records < 1:
            raise ValueError(f"records={self.records}; expected at least 1")
        chosen = Comparison(self.preset, _number(self.budget), self.seed, self.records)
        for method in METHODS:
            chosen.config(method)
        return chosen


def _number(budget: str) -> float | None:
    if budget == "none":
        return None
    try:
        return float(budget)
    except ValueError:
        raise ValueError(f"budget={budget!r}; expected CPU seconds or none") from None


def run_jobs(jobs: Sequence[PaperJob], processes: int) -> Iterator[tuple[PaperJob, Row | str]]:
    """Run jobs, one thread each, and yield each with its row or error message as it ends.

    A single job shows its own progress bar.
    """
    if len(jobs) == 1 or processes == 1:
        for job in jobs:
            yield _attempt(job, progress=len(jobs) == 1)
        return
    pool = ProcessPoolExecutor(processes)  # workers inherit the environment set above
    try:
        for ended in as_completed([pool.submit(_attempt, job) for job in jobs]):
            yield ended.result()
    finally:  # after Ctrl-C some jobs are still running
        pool.shutdown(kill_workers=True)


def _attempt(job: PaperJob, progress: bool = False) -> tuple[PaperJob, Row | str]:
    try:
        return job, run(job, progress)
    except Exception as error:
        return job, f"{type(error).__name__}: {error}"


def work(jobs: Sequence[PaperJob], processes: int, results: Path) -> int:
    """Run jobs, store and report the row of each as it ends; return the number of failures."""
    failed = 0
    columns = (SpinnerColumn(), TextColumn("cases"), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console, disable=len(jobs) == 1) as bar:
        task = bar.add_task("", total=len(jobs))
        for job, row in run_jobs(jobs, processes):
            if isinstance(row, str):
                failed += 1
                console.print(f"{job.case.name} failed: {row}", style="red", markup=False)
            else:
                append_lines(results, [row])
                figures = f"RMSE {row['rmse']:.4g}, loss {row['loss']:.3g}"
                console.print(
                    f"{job.case.name}: {figures}, {row['seconds']:.0f} CPU s; {job.folder}"
                )
            bar.advance(task)
    return failed


def show(table: Table, rows: Sequence[Row], path: Path) -> None:
    """Print a table and write it as Markdown."""
    columns = (
        Column(name, priority=max(i - 5, 0), numeric=i >= 2) for i, name in enumerate(report.HEADER)
    )
    grid = Grid(table.title, tuple(columns), tuple(map(tuple, report.lines(table, rows))))
    print_table([[grid]], f"{path} has all")
    notes = [*table.notes, report.starts(table), *report.PROTOCOL]
    for note in notes:
        console.print(note, style="dim", markup=False, highlight=False)
    parts = [f"# {table.title}", report.markdown(table, rows), *report.PROTOCOL]
    if rows:
        parts.append(report.measured_on(rows))
    with replacing(path) as temporary:
        temporary.write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    console.print(f"table: {path}", soft_wrap=True)


def reproduce(options: Options) -> int:
    """Run the missing cases and show the table; return the exit status."""
    jobs, results = options.chosen(), options.out / "results.jsonl"
    check_writable(options.out)
    known = report.read(results)
    missing = [job for job in jobs if not report.is_done(job, known)]
    if len(missing) < len(jobs):
        console.print(f"{len(jobs) - len(missing)} of {len(jobs)} cases already exist")
    status = 0
    try:
        status = int(bool(missing) and work(missing, options.jobs, results) > 0)
    except KeyboardInterrupt:
        print("stopped; the same command continues it", file=sys.stderr)
        status = 130
    show(TABLES[options.table], report.read(results), options.out / f"{options.table}.md")
    return status


def compare(options: Options) -> int:
    """Run the missing cases of the comparison and show its table; return the exit status."""
    chosen, results = options.compared(), options.out / "comparison.jsonl"
    check_writable(options.out)
    status = 0
    try:
        for done in comparison.run(chosen, results, set(comparison.read(results))):
            console.print(done)
    except KeyboardInterrupt:
        print("stopped; the same command continues it", file=sys.stderr)
        status = 130
    rows = comparison.read(results)
    columns = (Column(name, numeric=i >= 4) for i, name in enumerate(comparison.HEADER))
    lines = map(tuple, comparison.lines(chosen, rows))
    print_table([[Grid("Comparison", tuple(columns), tuple(lines))]])
    for note in chosen.protocol():
        console.print(note, style="dim", markup=False, highlight=False)
    path = options.out / f"{COMPARISON}.md"
    with replacing(path) as temporary:
        temporary.write_text(comparison.markdown(chosen, rows), encoding="utf-8")
    console.print(f"table: {path}", soft_wrap=True)
    return status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit status: 0, 1 if a case failed, 2 for invalid input, 130
    after Ctrl-C."""
    try:
        options = tyro.cli(Options, args=arguments)
        return (compare if options.table == COMPARISON else reproduce)(options)
    except ValueError as error:
        print(f"reproduce_paper: error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
