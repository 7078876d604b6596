"""Terminal output: the console, progress bars and tables."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.segment import Segment

from pinnobs_gym.leaderboard.display import printable_lines
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.grid import PROSE, Layouts, fitting
from pinnobs_gym.training.progress import in_terminal


class PrintableConsole(Console):
    """A console that writes no control character but its own: whatever is printed, a table, a text
    or a bar, its letters go through `printable_lines`."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for segment in super().render(renderable, options):
            if segment.control or segment.text.isprintable():
                yield segment
            else:
                yield Segment(printable_lines(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """Leave it to `pinnobs_gym.cli.streams`, which ends all commands in one way."""
        raise BrokenPipeError


_PLAIN: dict[str, Any] = {"markup": False, "emoji": False}
console = (
    PrintableConsole(**_PLAIN)
    if in_terminal()
    else PrintableConsole(**_PLAIN, force_terminal=False, width=PROSE)
)
"""The console for all output. Names are data: brackets and colons in them are printed as they
are."""


def table_width() -> int | None:
    """Return the width of tables: that of the terminal; elsewhere the environment variable COLUMNS
    or, without it, None: a pipe or a file gets all columns, as ``less -S`` can show them. The
    output of a notebook's cell is a terminal only to the command, and has `PROSE` columns."""
    if console.is_terminal:
        return console.width
    if sys.stdout is not None and sys.stdout.isatty():
        return PROSE
    given = os.environ.get("COLUMNS", "")
    return int(given) if given.isdecimal() and int(given) else None


def print_next(*words: object) -> None:
    """Print the command to type next, given its words after ``pinnobs``."""
    line = " ".join(quoted(str(word)) for word in words)
    console.print(f"next: pinnobs {line}", soft_wrap=True, highlight=False)


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
