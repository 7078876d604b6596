"""The interface of process pools, and the simplest pool: the current process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Future
from types import TracebackType
from typing import Any, ClassVar, Self

from pinnobs_gym.leaderboard.jobs.interface import Origin, Outcome, PicklableJob
from pinnobs_gym.leaderboard.jobs.worker import attempt_here

DIED = "its process died more than once"
"""The error of a job whose process died without a reason that is known."""


class WorkerLost(Exception):
    """A process died, possibly while running this job; the message has the exit codes."""


class WorkersLost(ConnectionError):
    """All workers are lost; finished results are kept."""


class Pool(ABC):
    """Processes that run jobs. The context is entered before the first job; if it ends with an
    error, running jobs are stopped."""

    size: int
    """Number of jobs run at a time."""
    queued: int | None
    """Largest number of unfinished jobs submitted, including running ones; None for no limit."""
    children: ClassVar[bool]
    """Whether the workers are children of this process."""

    @abstractmethod
    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Any:
        """Queue an attempt at a job and return its future, which has an ``add_done_callback``.

        Raises:
            CannotSend: in one line, if the job cannot be pickled.
            WorkersLost: in one line, if all workers are lost.
        """

    @abstractmethod
    def outcome(self, future: Any) -> Outcome:
        """Return the outcome of a job whose future is done.

        Raises:
            WorkerLost: if the job may have killed its process; it must be run again on its own.
            WorkersLost: in one line, if all workers are lost.
        """

    def __enter__(self) -> Self:
        return self

    @abstractmethod
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None: ...


class ThisProcess(Pool):
    """Runs each job in the current process when it is submitted."""

    size = 1
    queued = 1
    children = False

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        future: Future[Outcome] = Future()
        future.set_result(attempt_here(job))
        return future

    def outcome(self, future: Future[Outcome]) -> Outcome:
        return future.result()

    def __exit__(self, *_: object) -> None:
        pass
