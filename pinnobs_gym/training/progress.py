"""Progress of long runs: live in a terminal, in lines elsewhere."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

Show: TypeAlias = Callable[[float, str], None]
"""Called with the finished fraction and a few words."""
EVERY = 10.0
"""Shortest time in s between two lines outside a terminal."""
_BAR_WIDTH = 50
"""Number of characters of a bar before its words."""


def in_terminal() -> bool:
    """Return whether standard output is a terminal that can be rewritten. That of a notebook's
    ``!command`` is none, whatever it says: every frame of a live view would be a line of it."""
    notebook = "JPY_PARENT_PID" in os.environ or "inline" in os.environ.get("MPLBACKEND", "")
    return sys.stdout is not None and sys.stdout.isatty() and not notebook


@contextmanager
def shown_progress() -> Iterator[Show]:
    """Show a progress bar in a terminal, and elsewhere a line at most every `EVERY` s; yield the
    function that updates it."""
    if in_terminal():
        with _bar() as show:
            yield show
        return
    begun = said = time.monotonic()

    def line(part: float, words: str) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said < EVERY:
            return
        said = now
        left = f", about {(now - begun) * (1 - part) / part:.0f} s left" if 0 < part < 1 else ""
        print(f"{words}: {100 * part:.0f} % after {now - begun:.0f} s{left}", flush=True)

    yield line


@contextmanager
def _bar() -> Iterator[Show]:
    """Show a bar, and yield the function that updates it."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from rich.progress import TimeRemainingColumn as TimeLeft
    from rich.table import Column

    def wide(width: int) -> Column:
        """Return a column that keeps its width."""
        return Column(min_width=width, no_wrap=True)

    columns = (
        BarColumn(bar_width=12, table_column=wide(12)),
        TextColumn("{task.percentage:3.0f} %", table_column=wide(5)),
        TimeElapsedColumn(table_column=wide(7)),
        TextColumn("so far,", table_column=wide(7)),
        TimeLeft(table_column=wide(7)),
        TextColumn("left", table_column=wide(4)),
        TextColumn("{task.description}", markup=False),
    )
    with Progress(*columns) as progress:
        task = progress.add_task("", total=1.0)

        def show(part: float, words: str) -> None:
            room = max(progress.console.width - _BAR_WIDTH, 0)  # rich would cut all columns
            shown = words if len(words) <= room else words[: max(room - 1, 0)] + "…"
            progress.update(task, completed=part, description=shown)

        yield show
