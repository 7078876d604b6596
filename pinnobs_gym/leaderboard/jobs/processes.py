"""Running jobs in worker processes of this machine, started by loky.

loky's executor has the interface of `concurrent.futures` and three further properties: its workers
are started afresh instead of forked, on every operating system; it can be shut down at once,
including running jobs; and if a worker dies, the executor breaks instead of waiting for ever.
"""

from __future__ import annotations

import re
import signal
from concurrent.futures import Future
from types import TracebackType

from loky import BrokenProcessPool, ProcessPoolExecutor, get_reusable_executor

from pinnobs_gym.leaderboard.jobs.pool import Pool, WorkerLost
from pinnobs_gym.leaderboard.jobs.worker import Origin, Outcome, PicklableJob, attempt, interrupts

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


class ProcessPool(Pool):
    """Worker processes of this machine.

    If one dies, all submitted jobs are lost with it; new workers are started for the next job.

    Args:
        size: number of processes.
    """

    children = True

    def __init__(self, size: int) -> None:
        self.size = size
        self.queued = 2 * size  # a worker always finds its next job in the queue
        self._executor = self._usable()

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        with interrupts(signal.SIG_IGN, unless=signal.SIG_IGN):  # inherited by new workers
            while True:
                self._executor = self._usable()
                try:
                    return self._executor.submit(attempt, number, job, origin)
                except BrokenProcessPool:  # it broke since the check
                    continue

    def outcome(self, future: Future[Outcome]) -> Outcome:
        try:
            return future.result()
        except BrokenProcessPool as death:
            codes = re.search(r"\{.*\}", str(death))  # such as {SIGKILL(-9)}
            raise WorkerLost(f"exit codes {codes[0]}" if codes else str(death)) from None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is not None:
            self._executor.shutdown(kill_workers=True)

    def _usable(self) -> ProcessPoolExecutor:
        """Return the executor, or a new one if it is broken. Workers ignore Ctrl-C, including those
        that loky starts later: the client handles it and stops them."""
        return get_reusable_executor(
            self.size,
            timeout=IDLE,
            kill_workers=True,
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_IGN),
            env=ONE_THREAD,
        )
