"""Running jobs in processes, of this machine or of many.

The engine hands jobs to a `Pool` and takes in what becomes of them as they end. There are three
pools: this very process, worker processes of this machine
(`pinnobs_gym.leaderboard.jobs.processes`) and the workers of a Dask scheduler
(`pinnobs_gym.leaderboard.jobs.cluster`). Each process runs one job at a time on one numerical
thread; see `pinnobs_gym.leaderboard.jobs.worker`.
"""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, NamedTuple
from uuid import uuid4

from pinnobs_gym.files import holding, is_held
from pinnobs_gym.leaderboard.jobs.pool import Pool, ThisProcess, WorkerLost
from pinnobs_gym.leaderboard.jobs.worker import Origin, Outcome, PicklableJob
from pinnobs_gym.scoring.rows import CannotWrite

LISTEN = 0.5
"""Seconds between two looks for Ctrl-C while no job ends: Windows does not interrupt a wait."""


class Ended(NamedTuple):
    """A job that has ended."""

    job: Any
    error: str | None
    """What went wrong, in one line; None if nothing."""


@dataclass(frozen=True)
class Workers:
    """The processes that run jobs."""

    processes: int = 1
    """How many of this machine. One is this very process: debuggers and profilers see the job, and
    nothing has to be started; but a job that kills its process then ends the run. More are worker
    processes."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers are then used instead."""


class Engine:
    """Runs jobs, one thread each, and tells of each as it ends.

    A job whose process dies may take the others of its pool with it. All that were handed out are
    then run again, one at a time after the rest, and one that dies once more has failed. Dask does
    the like by itself.

    Args:
        workers: the processes.
    """

    def __init__(self, workers: Workers) -> None:
        self._workers = workers
        self._under_way: dict[int, PicklableJob] = {}
        self.processes = workers.processes
        """How many jobs are run at a time."""

    @property
    def running(self) -> list[PicklableJob]:
        """The jobs that run now: of those handed out, those that have waited longest."""
        return list(self._under_way.values())[: self.processes]

    def run(self, jobs: Sequence[PicklableJob]) -> Iterator[Ended]:
        """Run jobs in this order, and yield each as it ends.

        Raises:
            ValueError: in one line, if nothing can be written, the scheduler or its workers are not
                there, or a worker does not see the folder.
            WorkersLost: in one line, if the scheduler is gone.
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
        """Run all jobs, and those whose process died once more, each alone."""
        suspects: dict[int, PicklableJob] = {}
        for number, future in self._futures(jobs.items(), pool, origin):
            try:
                outcome = pool.outcome(future)
            except WorkerLost:
                suspects[number] = jobs[number].anew()  # it may have written something
                continue
            yield _ended(jobs[number], outcome)
        for suspect in sorted(suspects.items()):
            ((number, future),) = self._futures([suspect], pool, origin)
            try:
                outcome = pool.outcome(future)
            except WorkerLost as lost:
                outcome = Outcome(str(lost), died=True)
            yield _ended(suspects[number], outcome)

    def _futures(
        self, jobs: Iterable[tuple[int, PicklableJob]], pool: Pool, origin: Origin
    ) -> Iterator[tuple[int, Any]]:
        """Hand out jobs, as many as the pool queues, and yield the number and the future of each
        as it is done. They are under way until then."""
        done: SimpleQueue[tuple[int, Any]] = SimpleQueue()
        waiting = iter(jobs)
        while True:
            free = None if pool.queued is None else pool.queued - len(self._under_way)
            for number, job in islice(waiting, free):
                self._under_way[number] = job
                future = pool.submit(number, job, origin)
                future.add_done_callback(partial(_put, done, number))
            if not self._under_way:
                return
            number, future = _next(done)
            del self._under_way[number]
            yield number, future


def _put(done: SimpleQueue[tuple[int, Any]], number: int, future: Any) -> None:
    done.put((number, future))


def _next(done: SimpleQueue[tuple[int, Any]]) -> tuple[int, Any]:
    """What is done next, which may be interrupted."""
    while True:
        try:
            return done.get(timeout=LISTEN)
        except Empty:
            continue


def _ended(job: PicklableJob, outcome: Outcome) -> Ended:
    """What became of a job.

    Raises:
        CannotWrite: if no other job would fare better.
    """
    if outcome.ends_all:
        raise CannotWrite(outcome.error)
    error = outcome.error
    if outcome.died:
        error = " ".join(f"its process died more than once ({error})".split())
        job.fail(error)
    return Ended(job, error)


def _pool(workers: Workers) -> AbstractContextManager[Pool]:
    """The pool, which gives up what it started when it is left with an error."""
    if workers.scheduler is not None:
        from pinnobs_gym.leaderboard.jobs.cluster import connected

        return connected(workers.scheduler)
    if workers.processes == 1:
        return ThisProcess()
    from pinnobs_gym.leaderboard.jobs.processes import ProcessPool

    return ProcessPool(workers.processes)


@contextmanager
def _origin(folder: Path, pool: Pool) -> Iterator[Origin]:
    """Make the mark of an `Origin` in a folder, for as long as jobs are run.

    This process holds it. A mark that nobody holds is of a run that was killed, and is deleted: on
    the same machine only, since not every shared folder passes locks on.
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
