"""What the engine asks of processes that run jobs, and the simplest pool: this very process."""

from __future__ import annotations

from abc import ABC, abstractmethod
from concurrent.futures import Future
from types import TracebackType
from typing import Any, ClassVar, Self

from pinnobs_gym.leaderboard.jobs.worker import Origin, Outcome, PicklableJob, attempt


class WorkerLost(Exception):
    """A process has died, and this job may have been its; the message says how it died."""


class WorkersLost(ConnectionError):
    """All workers are gone; what was finished is kept."""


class Pool(ABC):
    """Processes that run jobs. As a context it is entered before the first job; left with an error,
    it stops those that run."""

    size: int
    """How many jobs it runs at a time."""
    queued: int | None
    """How many jobs are handed to it at most, the running ones included; None for all of them."""
    children: ClassVar[bool]
    """Whether its processes are children of this one."""

    @abstractmethod
    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Any:
        """Queue an `attempt` at a job; returns its future, with an ``add_done_callback``.

        Raises:
            WorkersLost: in one line, if all workers are gone.
        """

    @abstractmethod
    def outcome(self, future: Any) -> Outcome:
        """What became of a job whose future is done.

        Raises:
            WorkerLost: if its process may have died of it; it is to be run again, alone.
            WorkersLost: in one line, if all workers are gone.
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
    """Runs each job as it is handed over, in this very process."""

    size = 1
    queued = 1
    children = False

    def submit(self, number: int, job: PicklableJob, origin: Origin) -> Future[Outcome]:
        future: Future[Outcome] = Future()
        future.set_result(attempt(number, job, origin))
        return future

    def outcome(self, future: Future[Outcome]) -> Outcome:
        return future.result()

    def __exit__(self, *_: object) -> None:
        pass
