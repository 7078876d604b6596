"""Execution of a job in a worker process of any pool."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

from threadpoolctl import threadpool_limits

from pinnobs_gym.files import CannotWrite, is_held, replacing
from pinnobs_gym.leaderboard.display import show_messages_printable

SEEN_AFTER = 5.0
"""Longest time in s until other machines of a shared folder see a new file."""


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
    died: bool = False
    """Whether its process died without reporting an outcome."""
    seconds: float = 0.0
    """How long it took, in s of wall-clock time."""


class Origin(NamedTuple):
    """The client: the process that submits the jobs."""

    pid: int
    host: str
    folder: str
    """Working folder, where plug-ins may be."""
    mark: Path
    """A folder that exists, and is held by the client, while jobs are run. Its existence shows a
    worker that it sees the folder to which rows are written. It holds a file for each job that has
    ended, named by the job's number, with the error as content."""
    children: bool
    """Whether workers are children of the client."""


_ONE_AT_A_TIME = threading.Lock()
"""Serialises the jobs of a process: numerical libraries share state between threads."""


def attempt(number: int, job: PicklableJob, origin: Origin) -> Outcome:
    """Run a job in a worker, unless an earlier attempt finished and its worker died before
    reporting it."""
    with _ONE_AT_A_TIME:
        try:
            _prepare(origin)
            outcome = _earlier_outcome(number, origin.mark)
            if outcome is None:
                begun = time.monotonic()
                outcome = Outcome(_run(job), seconds=time.monotonic() - begun)
                _note(number, outcome, origin.mark)
        except CannotWrite as error:
            return Outcome(str(error), ends_all=True)
    return outcome


def _run(job: PicklableJob) -> str | None:
    """Run a job; record and return its error in one line, None if it succeeded."""
    try:
        with interrupts(_stop, only=signal.default_int_handler):
            job.run()
    except _Stopped:
        raise KeyboardInterrupt from None
    except CannotWrite:
        raise
    except Exception as error:
        message = " ".join(f"{type(error).__name__}: {error}".split())[:1000]
        job.fail(message)
        return message
    return None


def _earlier_outcome(number: int, mark: Path) -> Outcome | None:
    """Return the outcome of a job that has already ended, None if it has not. Report success if the
    client no longer waits for the job."""
    try:
        return Outcome((mark / str(number)).read_text(encoding="utf-8") or None)
    except OSError:
        return None if mark.is_dir() else Outcome(None)


def _note(number: int, outcome: Outcome, mark: Path) -> None:
    """Record that a job has ended."""
    try:
        with replacing(mark / str(number), create_folder=False) as unfinished:
            unfinished.write_text(outcome.error or "", encoding="utf-8")
    except CannotWrite:
        if mark.is_dir():  # else the client no longer waits for the outcome
            raise


def _prepare(origin: Origin) -> None:
    """Prepare a process for jobs, and check that it sees the client's folder.

    Raises:
        CannotWrite: if it does not see the folder.
    """
    here = socket.gethostname()
    if (here, os.getpid()) == (origin.host, origin.pid):
        return
    if origin.children and _is_orphan(origin):
        os._exit(1)  # the client no longer waits for this job
    _one_thread()
    show_messages_printable()
    if origin.folder not in sys.path:
        sys.path.append(origin.folder)  # to import module:Class from the user's folder
    deadline = time.monotonic() + SEEN_AFTER
    while not origin.mark.exists():
        if time.monotonic() > deadline:
            raise CannotWrite(
                f"the worker on {here} does not see folder {origin.mark.parent} of {origin.host}; "
                "expected a folder that all machines share"
            )
        time.sleep(0.2)


def _is_orphan(origin: Origin) -> bool:
    """Return whether the client was killed. On Windows a process keeps its parent's id, so that the
    client's lock is checked instead."""
    return os.getppid() != origin.pid if os.name == "posix" else not is_held(origin.mark)


@cache
def _one_thread() -> None:
    """Limit numerical libraries to one thread, once per process."""
    threadpool_limits(1)


@contextmanager
def interrupts(handler: Any, *, only: Any = None, unless: Any = None) -> Iterator[None]:
    """Install a handler of Ctrl-C for the duration of the context, in the main thread only.

    With ``only``, the present handler is replaced only if it is that one; with ``unless``, only if
    it is not that one.
    """
    main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if main else None
    if before is None or before is unless or (only is not None and before is not only):
        yield
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Stopped(BaseException):
    """Ctrl-C during a job in the current process. It differs from KeyboardInterrupt, on which
    trainers return their result so far, which must not be scored."""


def _stop(number: int, frame: object) -> None:
    raise _Stopped
