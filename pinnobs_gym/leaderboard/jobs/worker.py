"""What happens to a job in a worker, whichever process that is."""

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
from uuid import uuid4

from threadpoolctl import threadpool_limits

from pinnobs_gym.files import is_held
from pinnobs_gym.scoring.rows import CannotWrite

SEEN_AFTER = 5.0
"""Seconds that a file takes at most to be seen on other machines of a shared folder."""


class PicklableJob(Protocol):
    """What the engine runs: anything that can be pickled and does all of its work by itself."""

    @property
    def folder(self) -> Path:
        """Where it writes."""
        ...

    @property
    def name(self) -> str:
        """What it does, in a few words."""
        ...

    def run(self) -> None:
        """Do the work and write what comes of it."""

    def anew(self) -> Self:
        """The same job, to be run although it was under way before."""
        ...

    def fail(self, error: str) -> None:
        """Write down what went wrong.

        Raises:
            CannotWrite: if it cannot.
        """


class Outcome(NamedTuple):
    """What became of a job."""

    error: str | None
    """What went wrong, in one line; None if nothing."""
    ends_all: bool = False
    """Whether no other job would fare better."""
    died: bool = False
    """Whether its process died, and could not say so."""


class Origin(NamedTuple):
    """The client: the process that hands out the jobs."""

    pid: int
    host: str
    folder: str
    """Working folder, where plug-ins may be."""
    mark: Path
    """A folder that is there, and is held by the client, while jobs are run. By it workers know
    that they see the folder that is written to. For each job that has ended there is a file in it,
    named by the job's number, that holds what went wrong."""
    children: bool
    """Whether workers are children of the client."""


_ONE_AT_A_TIME = threading.Lock()
"""Jobs of one process run after each other: numerical libraries share state between threads."""


def attempt(number: int, job: PicklableJob, origin: Origin) -> Outcome:
    """Run a job in a worker, unless that was done and the worker died before it could say so."""
    with _ONE_AT_A_TIME:
        try:
            _prepare(origin)
            outcome = _earlier_outcome(number, origin.mark)
            if outcome is None:
                outcome = Outcome(_run(job))
                _note(number, outcome, origin.mark)
        except CannotWrite as error:
            return Outcome(str(error), ends_all=True)
    return outcome


def _run(job: PicklableJob) -> str | None:
    """Run a job; what went wrong, in one line, is written down."""
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
    """What became of a job that has ended already; nothing went wrong if nobody waits for it."""
    try:
        return Outcome((mark / str(number)).read_text(encoding="utf-8") or None)
    except OSError:
        return None if mark.is_dir() else Outcome(None)


def _note(number: int, outcome: Outcome, mark: Path) -> None:
    """Write down that a job has ended."""
    unfinished = mark / f"{number}.{uuid4().hex}"
    try:
        unfinished.write_text(outcome.error or "", encoding="utf-8")
        os.replace(unfinished, mark / str(number))
    except FileNotFoundError:  # nobody waits for the outcome any more
        return
    except OSError as cause:
        raise CannotWrite(f"cannot write {mark / str(number)}: {cause}") from None


def _prepare(origin: Origin) -> None:
    """Make a process ready for jobs, and see that it can do them.

    Raises:
        CannotWrite: if it does not see the folder.
    """
    here = socket.gethostname()
    if (here, os.getpid()) == (origin.host, origin.pid):
        return
    if origin.children and _is_orphan(origin):
        os._exit(1)  # nobody waits for this job
    _one_thread()
    if origin.folder not in sys.path:
        sys.path.append(origin.folder)  # for module:Class of the user's folder
    deadline = time.monotonic() + SEEN_AFTER
    while not origin.mark.exists():
        if time.monotonic() > deadline:
            raise CannotWrite(
                f"the worker on {here} does not see folder {origin.mark.parent} of {origin.host}; "
                "expected a folder that all machines share"
            )
        time.sleep(0.2)


def _is_orphan(origin: Origin) -> bool:
    """Whether the client was killed. On Windows a process keeps its parent's number for good."""
    return os.getppid() != origin.pid if os.name == "posix" else not is_held(origin.mark)


@cache
def _one_thread() -> None:
    """Run numerical libraries on one thread, once for a process."""
    threadpool_limits(1)


@contextmanager
def interrupts(handler: Any, *, only: Any = None, unless: Any = None) -> Iterator[None]:
    """Another handler of Ctrl-C, in the main thread: in place of ``only`` this one, or of any
    ``unless`` it is that one."""
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
    """Ctrl-C while a job is run in this very process. Trainers answer to a KeyboardInterrupt with
    what they have so far, which must not be scored."""


def _stop(number: int, frame: object) -> None:
    raise _Stopped
