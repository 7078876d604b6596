"""What trainers share: a bar, Ctrl-C, and the check of their settings."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def interruption() -> Iterator[list[bool]]:
    """A list that Ctrl-C puts something into, so that training ends between two iterations; a
    second Ctrl-C ends it at once. Elsewhere than in the main thread Ctrl-C is as ever."""
    stopped: list[bool] = []
    ours = threading.current_thread() is threading.main_thread()
    if not ours or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield stopped
        return

    def stop(number: int, frame: object) -> None:
        if stopped:
            raise KeyboardInterrupt
        stopped.append(True)

    signal.signal(signal.SIGINT, stop)
    try:
        yield stopped
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def bar(total: int | None) -> Iterator[Callable[[int, str], None]]:
    """A progress bar in the terminal, as a function of the iterations done and a description;
    nothing without a total."""
    if total is None:
        yield lambda done, description: None
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed}/{task.total}"),
        BarColumn(bar_width=20),
        TextColumn("{task.description}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns) as shown:
        task = shown.add_task("", total=total)
        yield lambda done, description: shown.update(task, completed=done, description=description)


def expect(config: object, name: str, expected: str, fits: Callable[[Any], bool]) -> None:
    """Whether a setting fits.

    Raises:
        ValueError: in one line, naming the setting, its value and what was expected.
    """
    value = getattr(config, name)
    try:
        good = fits(value)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"{name}={value!r}; expected {expected}")
