"""Execution of a job in a worker process of any pool."""

from __future__ import annotations

import os
import socket
import sys
import threading
import time
from contextvars import copy_context
from functools import cache
from pathlib import Path

from threadpoolctl import threadpool_limits

from pinnobs_gym.files import CannotWrite, is_held, replacing
from pinnobs_gym.leaderboard.display import show_messages_printable
from pinnobs_gym.leaderboard.jobs.interface import Origin, Outcome, Parcel, PicklableJob
from pinnobs_gym.leaderboard.jobs.isolation import isolated
from pinnobs_gym.leaderboard.jobs.stopping import interruptible
from pinnobs_gym.leaderboard.jobs.time_limit import exceeded, limited
from pinnobs_gym.registry import error_line

SEEN_AFTER = 5.0
"""Longest time in s until other machines of a shared folder see a new file."""


_ONE_AT_A_TIME = threading.Lock()
"""Serialises the jobs of a process: numerical libraries share state between threads."""


def attempt(number: int, parcel: Parcel, origin: Origin) -> Outcome:
    """Run a job in a worker, unless an earlier attempt has left an outcome behind."""
    with _ONE_AT_A_TIME:
        try:
            _prepare(origin)
            return left_behind(number, origin.mark) or _attempt(number, parcel, origin.mark)
        except CannotWrite as error:
            return Outcome(str(error), ends_all=True)


def attempt_here(job: PicklableJob) -> Outcome:
    """Run a job in the process of the client."""
    with _ONE_AT_A_TIME:
        try:
            return run_isolated(job)
        except CannotWrite as error:
            return Outcome(str(error), ends_all=True)


def left_behind(number: int, mark: Path) -> Outcome | None:
    """Return the outcome of an earlier attempt whose process ended before it was reported: that of
    a job that has ended or has exceeded its time limit; None if there is none. Report success if
    the client no longer waits for the job."""
    try:
        return Outcome((mark / str(number)).read_text(encoding="utf-8") or None)
    except OSError:
        if not mark.is_dir():
            return Outcome(None)
    late = exceeded(_running(number, mark), Path(__file__).name)
    return None if late is None else Outcome(late, unrecorded=True)


def _attempt(number: int, parcel: Parcel, mark: Path) -> Outcome:
    """Unpack and run a job within its time limit, and note its outcome."""
    path, limit = _running(number, mark), parcel.time_limit
    try:
        with limited(limit, path):  # the time of imports is not part of the job's
            job = _unpacked(parcel)
        if isinstance(job, Outcome):
            return job
        with limited(limit, path):
            outcome = run_isolated(job)
    except FileNotFoundError:  # the client no longer waits for the outcome
        return Outcome(None)
    except OSError as cause:
        raise CannotWrite(f"cannot write {path}: {cause}") from None
    _note(number, outcome, mark)
    return outcome


def _running(number: int, mark: Path) -> Path:
    """Return the file of a job that is running; see `limited`."""
    return mark / f"{number}.running"


def _unpacked(parcel: Parcel) -> PicklableJob | Outcome:
    """Return the job, or the outcome if a plug-in cannot be imported here."""
    try:
        return parcel.open()
    except BaseException as error:
        return Outcome(f"it cannot be loaded: {error_line(error)}", unrecorded=True)


def run_isolated(job: PicklableJob) -> Outcome:
    """Run a job so that nothing that its plug-ins raise or change concerns another job; record its
    failure.

    Raises:
        CannotWrite: if no other job can succeed either.
        KeyboardInterrupt: if the user stops the run.
    """
    begun, error = time.monotonic(), None
    with interruptible() as stoppable, isolated() as left:
        try:
            copy_context().run(job.run)
        except CannotWrite:
            raise
        except BaseException as raised:  # plug-ins may raise anything, such as SystemExit
            if isinstance(raised, KeyboardInterrupt) and not stoppable:
                raise
            error = error_line(raised)
    seconds = time.monotonic() - begun
    if error is not None:
        try:
            job.fail(error)
        except CannotWrite:
            raise
        except Exception as second:  # of a plug-in whose name cannot be told, say
            error += f"; this could not be recorded: {error_line(second)}"
    return Outcome(error, seconds=seconds, leftovers=left.running)


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
    if origin.children and os.name != "posix" and not is_held(origin.mark):
        os._exit(1)  # the client was killed, which has no guard here
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


@cache
def _one_thread() -> None:
    """Limit numerical libraries to one thread, once per process."""
    threadpool_limits(1)
