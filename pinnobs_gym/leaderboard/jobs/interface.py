"""What passes between the client, which submits jobs, and the workers that run them."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple, Protocol, Self

import cloudpickle

from pinnobs_gym.registry import error_line


class PicklableJob(Protocol):
    """A job for the engine: it can be pickled and needs nothing but its own fields."""

    @property
    def folder(self) -> Path:
        """The folder to which it writes."""
        ...

    @property
    def name(self) -> str:
        """Short description of the job."""
        ...

    def run(self) -> None:
        """Do the work and write its results."""

    @property
    def time_limit(self) -> float | None:
        """Longest time in s of wall-clock time that it may take in a worker; None for no limit."""
        ...

    def anew(self) -> Self:
        """Return the same job, to be run again after an interrupted attempt."""
        ...

    def fail(self, error: str) -> None:
        """Record an error.

        Raises:
            CannotWrite: if it cannot be written.
        """


class Outcome(NamedTuple):
    """The outcome of a job."""

    error: str | None
    """The error in one line; None if the job succeeded."""
    ends_all: bool = False
    """Whether no other job can succeed either."""
    unrecorded: bool = False
    """Whether it failed and the failure is not recorded yet."""
    seconds: float = 0.0
    """How long it took, in s of wall-clock time."""
    leftovers: bool = False
    """Whether it left something running in its process, which should run no other job."""


class CannotSend(ValueError):
    """A job cannot be pickled."""


class Parcel(NamedTuple):
    """A job on its way to a worker."""

    data: bytes
    """The pickled job."""
    time_limit: float | None
    """Its `PicklableJob.time_limit`."""

    @classmethod
    def of(cls, job: PicklableJob) -> Self:
        """Pack a job; classes of the main module are packed with it.

        Raises:
            CannotSend: in one line, if it cannot be pickled.
        """
        try:
            return cls(cloudpickle.dumps(job), job.time_limit)
        except Exception as error:  # of a plug-in's own method
            message = f"it cannot be sent to a worker: {error_line(error)}"
            raise CannotSend(message) from None

    def open(self) -> PicklableJob:
        """Return the job, whose plug-ins are imported by this."""
        return cloudpickle.loads(self.data)


class Origin(NamedTuple):
    """The client: the process that submits the jobs."""

    pid: int
    host: str
    folder: str
    """Working folder, where plug-ins may be."""
    mark: Path
    """A folder that exists, and is held by the client, while jobs are run. Its existence shows a
    worker that it sees the folder to which rows are written. It holds a file for each job that has
    ended, named by the job's number, with the error as content, and one for each that runs; see
    `limited`."""
    children: bool
    """Whether workers are children of the client."""
