"""What happens to a job in a worker, whichever process that is."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

from threadpoolctl import threadpool_limits

from pinnobs_gym.files import locked, write_whole
from pinnobs_gym.scoring.rows import CannotWrite

SEEN_AFTER = 5.0
"""Seconds that a file takes at most to be seen on other machines of a shared folder."""


class Job(Protocol):
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
    """What a worker tells of a job."""

    number: int
    """The job's."""
    error: str | None
    """What went wrong."""
    ends_all: bool = False
    """Whether no other job would fare better."""
    died: bool = False
    """Whether the process died, and could not say so."""


class Home(NamedTuple):
    """Where jobs come from."""

    pid: int
    host: str
    folder: str
    """Working folder, where plug-ins may be."""
    mark: Path
    """A file by which workers know that they see the folder that is written to, and what of it is
    done: a line for each job that ended."""
    children: bool
    """Whether workers are children of that process."""


_ONE_AT_A_TIME = threading.Lock()
"""Jobs of one process run after each other: numerical libraries share state between threads."""


def attempt(number: int, job: Job, home: Home) -> Outcome:
    """Run a job in a worker, unless that was done and the worker died before it could say so."""
    with _ONE_AT_A_TIME:
        try:
            _settle_in(home)
            ended = _ended_before(number, home.mark)
            if ended is not None:
                return ended
            told = _run(job)
            _note(number, told, home.mark)
        except CannotWrite as error:
            return Outcome(number, str(error), ends_all=True)
    return Outcome(number, told)


def _run(job: Job) -> str | None:
    """Run a job; what went wrong, in one line, is written down."""
    try:
        with handling(_stop, lambda before: before is signal.default_int_handler):
            job.run()
    except _Stopped:
        raise KeyboardInterrupt from None
    except CannotWrite:
        raise
    except Exception as error:
        told = " ".join(f"{type(error).__name__}: {error}".split())[:1000]
        job.fail(told)
        return told
    return None


def _ended_before(number: int, mark: Path) -> Outcome | None:
    try:
        lines = mark.read_text(encoding="utf-8").splitlines()
    except OSError:  # it is gone: nobody waits for the outcome
        return Outcome(number, None)
    for line in lines:
        first, _, error = line.partition(" ")
        if first == str(number):
            return Outcome(number, error or None)
    return None


def _note(number: int, error: str | None, mark: Path) -> None:
    """Write down that a job has ended."""
    data = f"{number} {error or ''}\n".encode()
    try:
        with locked(mark, make=False) as descriptor:
            write_whole(descriptor, data, os.fstat(descriptor).st_size)
    except FileNotFoundError:  # nobody waits for the outcome any more
        return
    except OSError as cause:
        raise CannotWrite(f"cannot write {mark}: {cause}") from None


def _settle_in(home: Home) -> None:
    """Make a process ready for jobs, and see that it can do them.

    Raises:
        CannotWrite: if it does not see the folder.
    """
    here = socket.gethostname()
    if (here, os.getpid()) == (home.host, home.pid):
        return
    if home.children and os.getppid() != home.pid:
        os._exit(1)  # that process was killed, and nobody waits for this job
    _one_thread()
    if home.folder not in sys.path:
        sys.path.append(home.folder)  # for module:Class of the user's folder
    deadline = time.monotonic() + SEEN_AFTER
    while not home.mark.exists():
        if time.monotonic() > deadline:
            raise CannotWrite(
                f"the worker on {here} does not see folder {home.mark.parent} of {home.host}; "
                "expected a folder that all machines share"
            )
        time.sleep(0.2)


@cache
def _one_thread() -> None:
    """Run numerical libraries on one thread, once for a process."""
    threadpool_limits(1)


@contextmanager
def handling(handler: Any, of: Callable[[Any], bool]) -> Iterator[None]:
    """Another handler of Ctrl-C, in the main thread, in place of some."""
    ours = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if ours else None
    if before is None or not of(before):
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


class Lost(ConnectionError):
    """The workers are gone; what was finished is kept."""
