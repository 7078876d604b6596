"""Running jobs in worker processes of this machine, started by loky.

loky starts processes afresh instead of forking them, on every operating system, and tells if one
dies. Each worker has an executor of its own. If it dies, no other job is lost with it.
"""

from __future__ import annotations

import os
import re
from concurrent.futures import Future
from functools import cache
from types import TracebackType

from loky import BrokenProcessPool, ProcessPoolExecutor
from loky.backend.resource_tracker import ensure_running

from pinnobs_gym.leaderboard.jobs.interface import Origin, Outcome, Parcel, PicklableJob
from pinnobs_gym.leaderboard.jobs.pool import Pool, WorkerLost, WorkersLost
from pinnobs_gym.leaderboard.jobs.stopping import ignoring_ctrl_c
from pinnobs_gym.leaderboard.jobs.worker import attempt
from pinnobs_gym.leaderboard.jobs.worker_process import Guard, begin, end_group

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


class _Worker:
    """A worker process, as an executor of one process."""

    def __init__(self) -> None:
        self.executor = ProcessPoolExecutor(1, timeout=IDLE, initializer=begin, env=ONE_THREAD)
        self._processes: set[int] = set()

    def submit(self, number: int, parcel: Parcel, origin: Origin, guard: Guard) -> Future[Outcome]:
        """Submit a job; see `attempt`."""
        future = self.executor.submit(attempt, number, parcel, origin)
        for process in set(self.executor._processes) - self._processes:  # it is new, or replaced
            self._processes.add(process)
            guard.watch(process)
        return future

    def end_processes(self, guard: Guard) -> None:
        """Kill its process, and what that has started."""
        for process in self._processes:
            end_group(process)
            guard.forget(process)


_IDLE_WORKERS: list[_Worker] = []
"""The workers of earlier runs of this process."""


@cache
def _guard(client: int) -> Guard:
    """Start the processes beside the workers, and return the guard of this process, whose id is
    given, as a fork has none."""
    before = os.environ.get("PYTHONWARNINGS")
    # loky's resource tracker frees what a killed client leaves, and would warn of it.
    quiet = "ignore:resource_tracker:UserWarning"
    os.environ["PYTHONWARNINGS"] = f"{before},{quiet}" if before else quiet
    try:
        ensure_running()
    finally:
        if before is None:
            del os.environ["PYTHONWARNINGS"]
        else:
            os.environ["PYTHONWARNINGS"] = before
    return Guard()


class ProcessPool(Pool):
    """Worker processes of this machine.

    Args:
        size: number of processes.
    """

    children = True

    def __init__(self, size: int) -> None:
        self.size = self.queued = size
        self._guard = _guard(os.getpid())
        self._busy: dict[Future[Outcome], _Worker] = {}

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        parcel = Parcel.of(job)
        with ignoring_ctrl_c():  # inherited by new workers
            while True:
                worker = _IDLE_WORKERS.pop() if _IDLE_WORKERS else _Worker()
                try:
                    future = worker.submit(number, parcel, origin, self._guard)
                except BrokenProcessPool:  # it was killed while it was idle
                    continue
                except OSError as error:
                    raise WorkersLost(f"no process can be started: {error}") from None
                self._busy[future] = worker
                return future

    def outcome(self, future: Future[Outcome]) -> Outcome:
        worker = self._busy.pop(future)
        try:
            outcome = future.result()
        except BrokenProcessPool as death:
            self._end([worker])  # what it started is still there
            codes = re.search(r"\{.*\}", str(death))  # such as {SIGKILL(-9)}
            raise WorkerLost(f"exit codes {codes[0]}" if codes else str(death)) from None
        if outcome.leftovers:
            self._end([worker])
        else:
            _IDLE_WORKERS.append(worker)
        return outcome

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._end([*self._busy.values(), *_IDLE_WORKERS])
            _IDLE_WORKERS.clear()

    def _end(self, workers: list[_Worker]) -> None:
        """End workers and all that they have started, at once."""
        for worker in workers:
            worker.end_processes(self._guard)
        for wait in (False, True):
            for worker in workers:
                worker.executor.shutdown(wait, kill_workers=True)
