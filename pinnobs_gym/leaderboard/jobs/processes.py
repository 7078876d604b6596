"""Jobs in worker processes of this machine, which loky starts.

loky's executor is that of `concurrent.futures` with what is needed here besides: its workers are
started afresh instead of forked, on every operating system; it can be shut down at once, jobs
that run included; and if a worker dies, whatever it was doing, the executor is broken instead of
waiting for ever.
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
"""Seconds after which workers end that have nothing to do; the next run uses them until then."""
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
"""Environment of the workers: one thread for each numerical library."""


class ProcessPool(Pool):
    """Worker processes of this machine.

    If one dies, all that were handed jobs are lost with it, and are replaced for the next job.

    Args:
        size: how many.
    """

    children = True

    def __init__(self, size: int) -> None:
        self.size = size
        self.queued = 2 * size  # so that no worker waits for its next job
        self._executor = self._usable()

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        with interrupts(signal.SIG_IGN, unless=signal.SIG_IGN):  # which new workers inherit
            while True:
                self._executor = self._usable()
                try:
                    return self._executor.submit(attempt, number, job, origin)
                except BrokenProcessPool:  # just now
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
        """The executor, or a new one in its place if it is broken. Workers ignore Ctrl-C, also
        those that loky starts later: it is for the client, which then stops them."""
        return get_reusable_executor(
            self.size,
            timeout=IDLE,
            kill_workers=True,
            initializer=signal.signal,
            initargs=(signal.SIGINT, signal.SIG_IGN),
            env=ONE_THREAD,
        )
