"""Running jobs in worker processes of this machine, started by loky.

loky starts processes afresh instead of forking them, on every operating system, and tells if one
dies. Each worker has an executor of its own. If it dies, no other job is lost with it.
"""

from __future__ import annotations

import os
import re
from concurrent.futures import Future
from types import TracebackType
from typing import NamedTuple

from loky import BrokenProcessPool, ProcessPoolExecutor

from pinnobs_gym.leaderboard.jobs.interface import Origin, Outcome, Parcel, PicklableJob
from pinnobs_gym.leaderboard.jobs.pool import Pool, WorkerLost, WorkersLost
from pinnobs_gym.leaderboard.jobs.stopping import ignoring_ctrl_c
from pinnobs_gym.leaderboard.jobs.worker import attempt
from pinnobs_gym.leaderboard.jobs.worker_process import begin, end_group

IDLE = 300
"""Seconds after which idle workers exit; the next run may reuse them until then."""
ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "BLIS_NUM_THREADS",
        "VECLIB_MAXIMUM_THREADS",
    ),
    "1",
)
"""Environment of the workers: one thread per numerical library."""
_IDLE_WORKERS: list[ProcessPoolExecutor] = []
"""The workers of earlier runs of this process, each an executor of one process."""


class _Busy(NamedTuple):
    """A worker with a job."""

    executor: ProcessPoolExecutor
    processes: list[int]
    """Ids of its processes: one, unless it is being replaced."""


class ProcessPool(Pool):
    """Worker processes of this machine.

    Args:
        size: number of processes.
    """

    children = True

    def __init__(self, size: int) -> None:
        self.size = self.queued = size
        self._busy: dict[Future[Outcome], _Busy] = {}

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        parcel = Parcel.of(job)
        with ignoring_ctrl_c():  # inherited by new workers
            while True:
                executor = _IDLE_WORKERS.pop() if _IDLE_WORKERS else _new_worker()
                try:
                    future = executor.submit(attempt, number, parcel, origin)
                except BrokenProcessPool:  # it was killed while it was idle
                    continue
                except OSError as error:
                    raise WorkersLost(f"no process can be started: {error}") from None
                self._busy[future] = _Busy(executor, list(executor._processes))
                return future

    def outcome(self, future: Future[Outcome]) -> Outcome:
        busy = self._busy.pop(future)
        try:
            outcome = future.result()
        except BrokenProcessPool as death:
            _end([busy])  # what it started is still there
            codes = re.search(r"\{.*\}", str(death))  # such as {SIGKILL(-9)}
            raise WorkerLost(f"exit codes {codes[0]}" if codes else str(death)) from None
        if outcome.leftovers:
            _end([busy])
        else:
            _IDLE_WORKERS.append(busy.executor)
        return outcome

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            idle = [_Busy(each, list(each._processes)) for each in _IDLE_WORKERS]
            _IDLE_WORKERS.clear()
            _end([*self._busy.values(), *idle])


def _new_worker() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        1, timeout=IDLE, initializer=begin, initargs=(os.getpid(),), env=ONE_THREAD
    )


def _end(workers: list[_Busy]) -> None:
    """End workers and all that they have started, at once."""
    for worker in workers:
        for process in worker.processes:
            end_group(process)
    for worker in workers:
        worker.executor.shutdown(wait=False, kill_workers=True)
    for worker in workers:
        worker.executor.shutdown(kill_workers=True)
