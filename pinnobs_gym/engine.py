"""Running jobs in processes, of this machine or of many, through joblib."""

from __future__ import annotations

import os
import re
import signal
import socket
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol
from uuid import uuid4

import joblib
from threadpoolctl import threadpool_limits

from pinnobs_gym.rows import CannotWrite
from pinnobs_gym.shared_file import locked, write_whole

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

    def fail(self, error: str) -> None:
        """Write down what went wrong.

        Raises:
            CannotWrite: if it cannot.
        """


class Ended(NamedTuple):
    """A job that has ended."""

    job: Any
    error: str | None
    """What went wrong, in one line; None if nothing."""


class Lost(ConnectionError):
    """The workers are gone; what was finished is kept."""


@dataclass(frozen=True)
class Where:
    """Where jobs are run."""

    processes: int = 1
    """How many at a time on this machine. One is this very process, more are loky's."""
    scheduler: str | None = None
    """Address of a Dask scheduler, whose workers are then used instead."""


class Engine:
    """Runs jobs, one thread each, and tells of each as it ends.

    A job whose process dies takes the others of its pool with it. All that were under way are then
    run again, one at a time after the rest, and one that dies once more has failed. Dask does the
    like by itself.

    Args:
        where: the processes.

    Raises:
        ValueError: in one line, if the scheduler or its workers are not there.
    """

    def __init__(self, where: Where) -> None:
        self._where = where
        self._under_way: dict[int, Job] = {}
        self.processes = where.processes
        """How many jobs are run at a time."""

    @property
    def running(self) -> list[Job]:
        """The jobs that run now: of those handed out, those that have waited longest."""
        return list(self._under_way.values())[: self.processes]

    def run(self, jobs: Sequence[Job]) -> Iterator[Ended]:
        """Run jobs in this order, and yield each as it ends.

        Raises:
            ValueError: in one line, if nothing can be written, or a worker does not see the folder.
            Lost: in one line, if the scheduler is gone.
        """
        if not jobs:
            return
        with _backend(self._where) as backend, _mark(jobs[0].folder) as mark:
            self.processes = backend.processes
            children = self._where.scheduler is None
            home = Home(os.getpid(), socket.gethostname(), os.getcwd(), mark, children)
            yield from self._rounds(dict(enumerate(jobs)), backend, home)

    def _rounds(self, waiting: dict[int, Job], backend: _Backend, home: Home) -> Iterator[Ended]:
        """Run all that wait, going on after a process has died."""
        suspects: set[int] = set()
        while waiting:
            now = {i: job for i, job in waiting.items() if i not in suspects}
            alone = None if now else min(waiting)
            try:
                for outcome in self._parallel(
                    now if alone is None else {alone: waiting[alone]}, backend, home
                ):
                    yield self._ended(outcome, waiting)
            except BrokenProcessPool as death:
                if alone is not None:
                    codes = re.search(r"\{.*\}", str(death))  # such as {SIGKILL(-9)}
                    told = f"exit codes {codes[0]}" if codes else str(death)
                    yield self._ended(Outcome(alone, told, died=True), waiting)
                suspects |= self._under_way.keys()
            finally:
                self._under_way.clear()

    def _ended(self, outcome: Outcome, waiting: dict[int, Job]) -> Ended:
        """What became of a job, which waits no more."""
        number, error, ends_all, died = outcome
        if ends_all:
            raise CannotWrite(error)
        self._under_way.pop(number, None)
        job = waiting.pop(number)
        if died:
            error = " ".join(f"its process died more than once ({error})".split())
            job.fail(error)
        return Ended(job, error)

    def _parallel(self, jobs: dict[int, Job], backend: _Backend, home: Home) -> Iterator[Outcome]:
        """Run these jobs; what was handed out is under way until `_ended`."""

        def calls() -> Iterator[Any]:
            for number, job in jobs.items():
                self._under_way[number] = job
                yield joblib.delayed(_attempt)(number, job, home)

        with joblib.parallel_config(backend.name, n_jobs=backend.processes, **backend.options):
            options: Any = {"batch_size": 1, "pre_dispatch": backend.ahead}
            parallel: Any = joblib.Parallel(return_as="generator_unordered", **options)
            with _signals_ignored():  # by the processes that are started now: Ctrl-C is for us
                outcomes = parallel(calls())
        try:
            yield from outcomes
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that it did not come to its end
                outcomes.close()


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


class _Backend(NamedTuple):
    """How joblib is told of the processes."""

    name: Any
    processes: int
    ahead: int | str
    """How many jobs are handed out at first."""
    options: dict[str, Any]


@contextmanager
def _backend(where: Where) -> Iterator[_Backend]:
    if where.scheduler is None:
        options = {"inner_max_num_threads": 1} if where.processes > 1 else {}
        yield _Backend("loky", where.processes, 2 * where.processes, options)
        return
    from pinnobs_gym.dask_backend import DaskBackend, connected

    with connected(where.scheduler) as client:
        backend = DaskBackend(client)
        # All are queued at the scheduler: workers may come and go.
        yield _Backend(backend, backend.effective_n_jobs(-1), "all", {})


_ONE_AT_A_TIME = threading.Lock()
"""Jobs of one process run after each other: numerical libraries share state between threads."""


def _attempt(number: int, job: Job, home: Home) -> Outcome:
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
        with _handling(_stop, lambda before: before is signal.default_int_handler):
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
def _mark(folder: Path) -> Iterator[Path]:
    """The mark of a `Home` in a folder, for as long as jobs are run."""
    host = socket.gethostname()
    for old in folder.glob(f".running-{host}-*"):
        try:
            os.kill(int(old.name.split("-")[-2]), 0)
        except ProcessLookupError:  # that run was killed
            old.unlink(missing_ok=True)
        except (OSError, ValueError):
            pass
    mark = folder / f".running-{host}-{os.getpid()}-{uuid4().hex}"
    try:
        mark.touch()
    except OSError as error:
        raise CannotWrite(f"cannot write to folder {folder}: {error}") from None
    try:
        yield mark
    finally:
        with suppress(OSError):
            mark.unlink()


@contextmanager
def _handling(handler: Any, of: Callable[[Any], bool]) -> Iterator[None]:
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


def _signals_ignored() -> Any:
    return _handling(signal.SIG_IGN, lambda before: before is not signal.SIG_IGN)
