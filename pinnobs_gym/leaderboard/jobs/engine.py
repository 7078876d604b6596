"""Running jobs in processes of this or other machines.

The engine submits jobs to a `Pool` and handles their outcomes as they end. There are three pools:
the current process, worker processes of this machine (`pinnobs_gym.leaderboard.jobs.processes`) and
the workers of a Dask scheduler (`pinnobs_gym.leaderboard.jobs.cluster`). Each process runs one job
at a time on one numerical thread; see `pinnobs_gym.leaderboard.jobs.worker`.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple
from uuid import uuid4

from pinnobs_gym.files import CannotWrite, holding, is_held
from pinnobs_gym.leaderboard.jobs.interface import CannotSend, Origin, Outcome, PicklableJob
from pinnobs_gym.leaderboard.jobs.pool import DIED, Pool, ThisProcess, WorkerLost
from pinnobs_gym.leaderboard.jobs.worker import left_behind

LISTEN = 0.5
"""Seconds between two checks for Ctrl-C while no job ends: Windows does not interrupt a wait."""


class Ended(NamedTuple):
    """A job that has ended."""

    job: Any
    error: str | None
    """The error in one line; None if the job succeeded."""
    seconds: float
    """How long it took, in s of wall-clock time."""


@dataclass(frozen=True)
class Workers:
    """Configuration of the processes that run jobs."""

    processes: int = 1
    """Number of processes on this machine. With 1, jobs run in the current process: debuggers and
    profilers see them and no process has to be started, but a job that kills its process ends the
    run, and none has a time limit. With more, jobs run in worker processes."""
    apart: bool = False
    """Whether a single process, too, is a worker process, so that jobs have a time limit."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers are used instead."""


class Engine:
    """Runs jobs, one thread each, and yields each as it ends.

    A job whose process dies is run again, on its own after the others, since the process may have
    been killed for another reason; a job whose process dies again has failed. Dask does this by
    itself. A job that exceeds its time limit has failed.

    Args:
        workers: the processes.
    """

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self._under_way: dict[int, PicklableJob] = {}
        self.processes = workers.processes
        """Number of jobs run at a time."""

    @property
    def running(self) -> list[PicklableJob]:
        """The running jobs, assumed to be those submitted first of all unfinished ones."""
        return list(self._under_way.values())[: self.processes]

    def run(self, jobs: Sequence[PicklableJob]) -> Generator[Ended, None, None]:
        """Run jobs in this order, and yield each as it ends.

        Raises:
            ValueError: in one line, if nothing can be written, the scheduler or its workers cannot
                be reached, or a worker does not see the folder.
            WorkersLost: in one line, if the connection to the scheduler is lost.
        """
        if not jobs:
            return
        with _pool(self._workers) as pool, _origin(jobs[0].folder, pool) as origin:
            self.processes = pool.size
            try:
                yield from self._run(dict(enumerate(jobs)), pool, origin)
            finally:
                self._under_way.clear()

    def _run(self, jobs: dict[int, PicklableJob], pool: Pool, origin: Origin) -> Iterator[Ended]:
        """Run all jobs, then those whose process died once more, each on its own."""
        suspects: dict[int, PicklableJob] = {}
        for number, outcome in self._outcomes(jobs.items(), pool, origin):
            if isinstance(outcome, WorkerLost):
                suspects[number] = jobs[number].anew()  # it may have written rows
            else:
                yield _ended(jobs[number], outcome)
        for suspect in sorted(suspects.items()):
            ((number, outcome),) = self._outcomes([suspect], pool, origin)
            if isinstance(outcome, WorkerLost):
                outcome = Outcome(f"{DIED} ({outcome})", unrecorded=True)
            yield _ended(suspects[number], outcome)

    def _outcomes(
        self, jobs: Iterable[tuple[int, PicklableJob]], pool: Pool, origin: Origin
    ) -> Iterator[tuple[int, Outcome | WorkerLost]]:
        """Submit jobs, up to the pool's queue length, and yield the number and the outcome of each
        when it is done."""
        done: SimpleQueue[tuple[int, Any]] = SimpleQueue()
        waiting = iter(jobs)
        while True:
            while pool.queued is None or len(self._under_way) < pool.queued:
                number, job = next(waiting, (0, None))
                if job is None:
                    break
                try:
                    future = pool.submit(number, job, origin)
                except CannotSend as error:
                    yield number, Outcome(str(error), unrecorded=True)
                    continue
                self._under_way[number] = job
                future.add_done_callback(partial(_put, done, number))
            if not self._under_way:
                return
            number, future = _next(done)
            del self._under_way[number]
            try:
                outcome = pool.outcome(future)
            except WorkerLost as lost:
                outcome = left_behind(number, origin.mark) or lost
            yield number, outcome


def _put(done: SimpleQueue[tuple[int, Any]], number: int, future: Any) -> None:
    done.put((number, future))


def _next(done: SimpleQueue[tuple[int, Any]]) -> tuple[int, Any]:
    """Wait for the next finished job, interruptible by Ctrl-C."""
    while True:
        try:
            return done.get(timeout=LISTEN)
        except Empty:
            continue


def _ended(job: PicklableJob, outcome: Outcome) -> Ended:
    """Return the result of a job, after recording a failure that its process could not record.

    Raises:
        CannotWrite: if the outcome means that no other job can succeed.
    """
    if outcome.ends_all:
        raise CannotWrite(outcome.error)
    if outcome.unrecorded and outcome.error is not None:
        job.fail(outcome.error)
    return Ended(job, outcome.error, outcome.seconds)


def _pool(workers: Workers) -> AbstractContextManager[Pool]:
    """Return the pool; it stops its jobs if its context ends with an error."""
    if workers.scheduler is not None:
        from pinnobs_gym.leaderboard.jobs.cluster import connected

        return connected(workers.scheduler)
    if workers.processes == 1 and not workers.apart:
        return ThisProcess()
    from pinnobs_gym.leaderboard.jobs.processes import ProcessPool

    return ProcessPool(workers.processes)


@contextmanager
def _origin(folder: Path, pool: Pool) -> Iterator[Origin]:
    """Create the mark of an `Origin` in a folder for the duration of the run.

    This process holds the mark. Marks that nobody holds are left by killed runs and deleted, but
    only those of this machine, since not every shared folder supports locks.
    """
    host = socket.gethostname()
    mark = folder / f".running-{host}-{uuid4().hex}"
    with ExitStack() as stack:
        try:
            for old in folder.glob(f".running-{host}-*/"):
                if not is_held(old):
                    shutil.rmtree(old, ignore_errors=True)
            stack.enter_context(holding(mark))
            mark.mkdir()
        except OSError as error:
            raise CannotWrite(f"cannot write to folder {folder}: {error}") from None
        stack.callback(shutil.rmtree, mark, ignore_errors=True)
        yield Origin(os.getpid(), host, os.getcwd(), mark, pool.children)
