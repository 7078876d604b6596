"""Progress of many jobs in the terminal, with an estimate of the time left."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

from rich.console import Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.text import Text

from pinnobs_gym.cli.console import console


class Kind(NamedTuple):
    """What a job does. Jobs of one kind take about as long."""

    part: str
    """The part of the work, such as ``trainings``."""
    name: str
    """Name of what is run."""


class Running(Protocol):
    """What runs the jobs, as `pinnobs_gym.leaderboard.jobs.engine.Engine` does."""

    processes: int
    """Number of jobs run at a time."""

    @property
    def running(self) -> Sequence[Any]:
        """The running jobs, each with a ``name``."""
        ...


class TimeLeft:
    """Estimate of the time left, from how long jobs of the same kind took.

    Jobs with a training come first and take much longer than all others, so that the mean over all
    jobs that have ended would be far too long. A kind of which none has ended is taken to be like
    the others of its part. If there are none either, the estimate is a lower bound.

    Args:
        kinds: the kind of each job.
    """

    def __init__(self, kinds: Iterable[Kind]) -> None:
        self._left = Counter(kinds)
        self._ended: Counter[Kind | str] = Counter()
        self.seconds: dict[Kind | str, float] = {}
        """Sum of the seconds of the jobs that have ended, by kind and by part."""

    def ended(self, kind: Kind, seconds: float) -> None:
        """Count a job that has ended after so many s."""
        self._left[kind] -= 1
        for key in (kind, kind.part):
            self._ended[key] += 1
            self.seconds[key] = self.seconds.get(key, 0.0) + seconds

    def estimate(self, processes: int) -> tuple[float, bool] | None:
        """Return the time left in s, and whether it is an estimate of all jobs rather than a lower
        bound; None as long as no job has ended."""
        if not self._ended:
            return None
        total, complete = 0.0, True
        for kind, count in self._left.items():
            key = kind if kind in self._ended else kind.part
            if key in self._ended:
                total += count * self.seconds[key] / self._ended[key]
            else:
                complete = complete and not count
        return total / processes, complete


class RunView:
    """Progress of many jobs. In a terminal it shows live the counts of finished, running and failed
    jobs, the names of running ones, and the time left. Elsewhere it prints a line at once and at
    intervals. Failures are printed as they occur.

    Args:
        kinds: the kind of each job.
        engine: what runs them.
    """

    EVERY = 10.0
    """Shortest time in s between two lines."""
    SILENT = 30.0
    """Longest time in s without a line."""
    SHOWN = 8
    """Largest number of running jobs that are named."""

    def __init__(self, kinds: Sequence[Kind], engine: Running) -> None:
        self.done = 0
        self.failed = 0
        self._total = len(kinds)
        self._engine = engine
        self._parts = Counter(kind.part for kind in kinds)
        self._time_left = TimeLeft(kinds)
        self._bar = Progress(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            console=console,
        )
        self._task = self._bar.add_task("jobs", total=self._total)
        self._live = Live(self, console=console, refresh_per_second=4)
        self._printed_at = self._started_at = self._ended_at = time.monotonic()
        self._closed = threading.Event()

    def __enter__(self) -> Self:
        if console.is_terminal:
            self._live.start()
        elif self._total:
            parts = ", ".join(f"{count} {part}" for part, count in self._parts.items())
            self._print(f"jobs: {self._total} to run ({parts})")
            threading.Thread(target=self._print_when_silent, daemon=True).start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._closed.set()
        self._live.stop()
        self._ended_at = time.monotonic()

    def ended(self, name: str, kind: Kind, error: str | None, seconds: float) -> None:
        """Report that a job has ended after so many s."""
        self.done += error is None
        self.failed += error is not None
        self._time_left.ended(kind, seconds)
        self._bar.advance(self._task)
        if error is not None:
            console.print(f"failed: {name}: {error}", style="red", soft_wrap=True)
        last = self.done + self.failed == self._total
        if not console.is_terminal and (last or time.monotonic() - self._printed_at >= self.EVERY):
            self._print(self._line())

    def seconds(self) -> Mapping[str, float]:
        """Return the time in s that the whole run spent on each part: its duration, divided as the
        seconds of the jobs are."""
        spent = {part: self._time_left.seconds.get(part, 0.0) for part in self._parts}
        total = sum(spent.values())
        duration = self._ended_at - self._started_at
        return {part: duration * seconds / total for part, seconds in spent.items() if total}

    def _print(self, line: str) -> None:
        self._printed_at = time.monotonic()
        console.print(line, soft_wrap=True, highlight=False)

    def _print_when_silent(self) -> None:
        """Print a line whenever no job has ended for long."""
        while not self._closed.wait(max(0.1, self._printed_at + self.SILENT - time.monotonic())):
            if time.monotonic() - self._printed_at >= self.SILENT:
                self._print(self._line())

    def _line(self) -> str:
        parts = [f"jobs: {self.done} of {self._total} done", f"{self.failed} failed"]
        if self.done + self.failed < self._total:
            parts += [f"{len(self._engine.running)} running", *self._left()]
        return ", ".join([*parts, f"{_duration(time.monotonic() - self._started_at)} so far"])

    def _left(self) -> list[str]:
        """Return the time left in words; nothing as long as nothing is known."""
        estimate = self._time_left.estimate(self._engine.processes)
        if estimate is None:
            return []
        seconds, complete = estimate
        return [f"{'about' if complete else 'at least'} {_duration(seconds)} left"]

    def __rich__(self) -> Group:
        names = [job.name for job in self._engine.running]
        shown = [Text(f"  {name}", style="dim") for name in names[: self.SHOWN]]
        if len(names) > self.SHOWN:
            shown.append(Text(f"  and {len(names) - self.SHOWN} more", style="dim"))
        counts = Text(f"{self.done} done, {len(names)} running, ")
        counts.append(f"{self.failed} failed", style="red" if self.failed else "")
        counts.append("".join(f", {words}" for words in self._left()))
        return Group(self._bar, counts, *shown)


def _duration(seconds: float) -> str:
    """Format a duration, such as 3 min."""
    for size, unit in ((3600, "h"), (60, "min")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds:.0f} s"
