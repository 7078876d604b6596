"""Running jobs in processes, of this machine or of many, through joblib."""

from __future__ import annotations

import os
import re
import signal
import socket
import warnings
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import joblib

from pinnobs_gym.leaderboard.jobs.worker import Home, Job, Outcome, attempt, handling
from pinnobs_gym.scoring.rows import CannotWrite


class Ended(NamedTuple):
    """A job that has ended."""

    job: Any
    error: str | None
    """What went wrong, in one line; None if nothing."""


@dataclass(frozen=True)
class Where:
    """Where jobs are run."""

    processes: int = 1
    """How many at a time on this machine. One is this very process, more are loky's."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers are then used instead."""


class Engine:
    """Runs jobs, one thread each, and tells of each as it ends.

    A job whose process dies takes the others of its pool with it. All that were under way are then
    run again, one at a time after the rest, and one that dies once more has failed. Dask does the
    like by itself.

    Args:
        where: the processes.

    Raises:
        ValueError: in one line, if the scheduler or its workers are not there.
    """

    def __init__(self, where: Where) -> None:
        self._where = where
        self._under_way: dict[int, Job] = {}
        self.processes = where.processes
        """How many jobs are run at a time."""

    @property
    def running(self) -> list[Job]:
        """The jobs that run now: of those handed out, those that have waited longest."""
        return list(self._under_way.values())[: self.processes]

    def run(self, jobs: Sequence[Job]) -> Iterator[Ended]:
        """Run jobs in this order, and yield each as it ends.

        Raises:
            ValueError: in one line, if nothing can be written, or a worker does not see the folder.
            Lost: in one line, if the scheduler is gone.
        """
        if not jobs:
            return
        with _backend(self._where) as backend, _mark(jobs[0].folder) as mark:
            self.processes = backend.processes
            children = self._where.scheduler is None
            home = Home(os.getpid(), socket.gethostname(), os.getcwd(), mark, children)
            yield from self._rounds(dict(enumerate(jobs)), backend, home)

    def _rounds(self, waiting: dict[int, Job], backend: _Backend, home: Home) -> Iterator[Ended]:
        """Run all that wait, going on after a process has died."""
        suspects: set[int] = set()
        while waiting:
            now = {i: job for i, job in waiting.items() if i not in suspects}
            alone = None if now else min(waiting)
            try:
                for outcome in self._parallel(
                    now if alone is None else {alone: waiting[alone]}, backend, home
                ):
                    yield self._ended(outcome, waiting)
            except BrokenProcessPool as death:
                if alone is not None:
                    codes = re.search(r"\{.*\}", str(death))  # such as {SIGKILL(-9)}
                    told = f"exit codes {codes[0]}" if codes else str(death)
                    yield self._ended(Outcome(alone, told, died=True), waiting)
                suspects |= self._under_way.keys()
                for number in suspects & waiting.keys():  # they may have written something
                    waiting[number] = waiting[number].anew()
            finally:
                self._under_way.clear()

    def _ended(self, outcome: Outcome, waiting: dict[int, Job]) -> Ended:
        """What became of a job, which waits no more."""
        number, error, ends_all, died = outcome
        if ends_all:
            raise CannotWrite(error)
        self._under_way.pop(number, None)
        job = waiting.pop(number)
        if died:
            error = " ".join(f"its process died more than once ({error})".split())
            job.fail(error)
        return Ended(job, error)

    def _parallel(self, jobs: dict[int, Job], backend: _Backend, home: Home) -> Iterator[Outcome]:
        """Run these jobs; what was handed out is under way until `_ended`."""

        def calls() -> Iterator[Any]:
            for number, job in jobs.items():
                self._under_way[number] = job
                yield joblib.delayed(attempt)(number, job, home)

        with joblib.parallel_config(backend.name, n_jobs=backend.processes, **backend.options):
            options: Any = {"batch_size": 1, "pre_dispatch": backend.ahead}
            parallel: Any = joblib.Parallel(return_as="generator_unordered", **options)
            with _signals_ignored():  # by the processes that are started now: Ctrl-C is for us
                outcomes = parallel(calls())
        try:
            yield from outcomes
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it did not come to its end
                outcomes.close()


class _Backend(NamedTuple):
    """How joblib is told of the processes."""

    name: Any
    processes: int
    ahead: int | str
    """How many jobs are handed out at first."""
    options: dict[str, Any]


@contextmanager
def _backend(where: Where) -> Iterator[_Backend]:
    if where.scheduler is None:
        options = {"inner_max_num_threads": 1} if where.processes > 1 else {}
        yield _Backend("loky", where.processes, 2 * where.processes, options)
        return
    from pinnobs_gym.leaderboard.jobs.cluster import DaskBackend, connected

    with connected(where.scheduler) as client:
        backend = DaskBackend(client)
        # All are queued at the scheduler: workers may come and go.
        yield _Backend(backend, backend.effective_n_jobs(-1), "all", {})


@contextmanager
def _mark(folder: Path) -> Iterator[Path]:
    """The mark of a `Home` in a folder, for as long as jobs are run."""
    host = socket.gethostname()
    for old in folder.glob(f".running-{host}-*"):
        try:
            os.kill(int(old.name.split("-")[-2]), 0)
        except ProcessLookupError:  # that run was killed
            old.unlink(missing_ok=True)
        except (OSError, ValueError):
            pass
    mark = folder / f".running-{host}-{os.getpid()}-{uuid4().hex}"
    try:
        mark.touch()
    except OSError as error:
        raise CannotWrite(f"cannot write to folder {folder}: {error}") from None
    try:
        yield mark
    finally:
        with suppress(OSError):
            mark.unlink()


def _signals_ignored() -> Any:
    return handling(signal.SIG_IGN, lambda before: before is not signal.SIG_IGN)
