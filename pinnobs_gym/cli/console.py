"""Terminal output: the console, progress bars and tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Any, Self

from rich import box
from rich.console import Console, Group
from rich.live import Live
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table as RichTable
from rich.text import Text

from pinnobs_gym.leaderboard import standings_table

WIDE = 190
"""Width of a leaderboard's table with its intervals, in characters."""
_PLAIN: dict[str, Any] = {"markup": False, "emoji": False}
console = Console(**_PLAIN) if Console().is_terminal else Console(width=WIDE, **_PLAIN)
"""The console for all output; wide enough for the tables if it is not a terminal. Names are data:
brackets and colons in them are printed as they are."""


def print_table(table: standings_table.Table) -> None:
    """Print a leaderboard's table, without intervals on a narrow terminal."""
    wide = console.width >= WIDE
    shown = RichTable(title=table.title, title_justify="left", title_style="bold", box=box.SIMPLE)
    hidden = {"knows", "training", "NIS", "corr.", "tail / CRR"}
    hidden |= {"track"} if wide else {"90th pct.", "µs/step", "/ CRR", "ANEES", "covers %"}
    columns = [i for i, name in enumerate(standings_table.HEADER) if name not in hidden]
    for i in columns:
        name = standings_table.HEADER[i]
        text = name in ("estimator", "track")
        shown.add_column(name, justify="left" if text else "right", no_wrap=True)
    for line in standings_table.cells(table, intervals=wide):
        shown.add_row(*(line[i] for i in columns))
    console.print(shown)
    for standing, name in zip(table.standings, standings_table.names(table.standings), strict=True):
        trained = f"; trained: {standing.training}" if standing.training else ""
        console.print(f"  {name} knows: {standing.knows}{trained}")
    if table.note:
        console.print(f"  {table.note}", style="yellow")


def print_grid(title: str, header: Sequence[str], lines: Iterable[Sequence[str]]) -> None:
    """Print a table of text with names in its first column."""
    shown = RichTable(title=title, title_justify="left", title_style="bold", box=box.SIMPLE)
    for i, name in enumerate(header):
        shown.add_column(name, justify="right" if i else "left", overflow="fold")
    for line in lines:
        shown.add_row(*line)
    console.print(shown)


def progress() -> Progress:
    """Return a progress bar with counts and times."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console,
    )


class RunView:
    """Progress of many jobs. In a terminal it shows live the counts of finished, running and failed
    jobs, the names of running ones, and the time left. Elsewhere it prints a line at intervals.
    Failures are printed at once.

    Args:
        total: number of jobs.
        running: returns the names of the running jobs.
    """

    EVERY = 10.0
    """Shortest time in s between two lines."""
    SHOWN = 8
    """Largest number of running jobs that are named."""

    def __init__(self, total: int, running: Callable[[], Sequence[str]]) -> None:
        self.done = 0
        self.failed = 0
        self._total = total
        self._running = running
        self._bar = progress()
        self._task = self._bar.add_task("jobs", total=total)
        self._live = Live(self, console=console, refresh_per_second=4)
        self._printed_at = self._started_at = time.monotonic()

    def __enter__(self) -> Self:
        if console.is_terminal:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._live.stop()

    def ended(self, name: str, error: str | None) -> None:
        """Report that a job has ended."""
        self.done += error is None
        self.failed += error is not None
        self._bar.advance(self._task)
        if error is not None:
            console.print(f"failed: {name}: {error}", style="red", soft_wrap=True)
        now = time.monotonic()
        last = self.done + self.failed == self._total
        if not console.is_terminal and (last or now - self._printed_at >= self.EVERY):
            self._printed_at = now
            console.print(self._line(now - self._started_at), soft_wrap=True, highlight=False)

    def _line(self, seconds: float) -> str:
        ended = self.done + self.failed
        parts = [f"jobs: {self.done} of {self._total} done", f"{self.failed} failed"]
        if ended < self._total:
            left = seconds / ended * (self._total - ended)
            parts += [f"{len(self._running())} running", f"about {_duration(left)} left"]
        return ", ".join([*parts, f"{_duration(seconds)} so far"])

    def __rich__(self) -> Group:
        names = self._running()
        shown = [Text(f"  {name}", style="dim") for name in names[: self.SHOWN]]
        if len(names) > self.SHOWN:
            shown.append(Text(f"  and {len(names) - self.SHOWN} more", style="dim"))
        counts = Text(f"{self.done} done, {len(names)} running, ")
        counts.append(f"{self.failed} failed", style="red" if self.failed else "")
        return Group(self._bar, counts, *shown)


def _duration(seconds: float) -> str:
    """Format a duration, such as 3 min."""
    for size, unit in ((3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
