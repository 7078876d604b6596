"""Terminal output: the console, progress bars and tables."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

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
from rich.text import Text

from pinnobs_gym.leaderboard.grid import PROSE, Layouts, fitting

_PLAIN: dict[str, Any] = {"markup": False, "emoji": False}
console = Console(**_PLAIN) if Console().is_terminal else Console(width=PROSE, **_PLAIN)
"""The console for all output. Names are data: brackets and colons in them are printed as they
are."""


def table_width() -> int | None:
    """Return the width of tables: that of the terminal; elsewhere the environment variable COLUMNS
    or, without it, None: a pipe or a file gets all columns, as ``less -S`` can show them."""
    if console.is_terminal:
        return console.width
    given = os.environ.get("COLUMNS", "")
    return int(given) if given.isdecimal() and int(given) else None


def print_table(layouts: Layouts, hint: str = "") -> None:
    """Print a table in the first of its layouts that fits. ``hint`` says where the columns are
    found that do not."""
    width = table_width()
    for grid in fitting(layouts, width):
        console.out(grid.text(width, hint) + "\n", highlight=False)


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
