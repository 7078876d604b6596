"""The terminal: one console, a progress bar, a leaderboard's table."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich import box
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as RichTable

from pinnobs_gym import leaderboard

WIDE = 190
"""Columns that a leaderboard's table takes with its intervals."""
console = Console() if Console().is_terminal else Console(width=WIDE)
"""Where everything is printed; wide enough for the tables where there is no terminal."""


def print_table(table: leaderboard.Table) -> None:
    """Print a leaderboard's table; a narrow terminal is spared the intervals."""
    wide = console.width >= WIDE
    shown = RichTable(title=table.title, title_justify="left", title_style="bold", box=box.SIMPLE)
    hidden = {"is told", "training", "NIS", "corr.", "tail / CRR"}
    hidden |= {"track"} if wide else {"90th pct.", "µs/step", "/ CRR", "ANEES", "covers %"}
    columns = [i for i, name in enumerate(leaderboard.HEADER) if name not in hidden]
    for i in columns:
        name = leaderboard.HEADER[i]
        text = name in ("estimator", "track")
        shown.add_column(name, justify="left" if text else "right", no_wrap=True)
    for line in leaderboard.cells(table, intervals=wide):
        shown.add_row(*(line[i] for i in columns))
    console.print(shown)
    for standing in table.standings:
        trained = f"; trained: {standing.training}" if standing.training else ""
        console.print(f"  {standing.estimator} is told: {standing.knows}{trained}")
    if table.note:
        console.print(f"  {table.note}", style="yellow")


def print_grid(title: str, header: Sequence[str], lines: Iterable[Sequence[str]]) -> None:
    """Print a table of text whose first column is of names."""
    shown = RichTable(title=title, title_justify="left", title_style="bold", box=box.SIMPLE)
    for i, name in enumerate(header):
        shown.add_column(name, justify="right" if i else "left", overflow="fold")
    for line in lines:
        shown.add_row(*line)
    console.print(shown)


def progress() -> Progress:
    """A bar with counts and times."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )
