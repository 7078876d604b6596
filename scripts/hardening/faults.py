"""Faults within this process: file operations that fail, a stop at any of them, a limit of the size
of files, and plug-ins that misbehave. Whatever ends a run, the same command does the rest."""

from __future__ import annotations

import errno
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from itertools import count
from random import Random

from hardening import plug_ins
from hardening.material import Material
from hardening.runs import ESTIMATORS, Run, difference, leftovers, undisturbed
from hardening.trial import Hung, Outcome, Trial

MOST = 110
ERRORS = (errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EIO, errno.EMFILE, errno.EDQUOT)
_WRITING = os.O_WRONLY | os.O_RDWR
Injected = Callable[[str, str], None]
"""Called with an event and a path."""
_injected: list[Injected] = []
"""What is called at each change of a file system, in a list since an audit hook stays."""
_unremovable: set[str] = set()
"""The names of the files of which a removal failed, which may thus be left."""


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if not _injected:
        return
    if event == "open":
        path, _, flags = arguments
        if not (isinstance(flags, int) and flags & _WRITING):
            return
    elif event in ("os.rename", "os.mkdir", "os.remove"):
        path = arguments[0]
    else:
        return
    if isinstance(path, str | bytes | os.PathLike):
        _injected[0](event, os.fsdecode(path))


@cache
def _add_hook() -> None:
    """Add the hook, once, since it cannot be removed."""
    sys.addaudithook(_hook)


@contextmanager
def injected(folder: str, at: int, act: Injected, lasting: bool) -> Iterator[list[int]]:
    """Act at the change number ``at`` of a folder's files, and at all later ones if it lasts.
    Yields a list of the numbers of changes so far."""
    _add_hook()
    seen: list[int] = []

    def called(event: str, path: str) -> None:
        if path.startswith(folder):
            seen.append(len(seen))
            if seen[-1] == at or (lasting and seen[-1] > at):
                if event == "os.remove":
                    _unremovable.add(os.path.basename(path))
                act(event, path)

    _injected[:] = [called]
    _unremovable.clear()
    try:
        yield seen
    finally:
        _injected.clear()


@contextmanager
def small_files(size: int) -> Iterator[None]:
    """Let no file grow beyond a size in bytes, on systems that can."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield faults."""
    numbers = count()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # nohup has it ignored
    expected = undisturbed(material, next(numbers))
    run = Run(material, next(numbers))
    with injected(str(run.out), -1, lambda event, path: None, False) as seen:
        run.here()
    changes = len(seen)
    for name in (*plug_ins.RAISING, *plug_ins.DISTURBING):
        yield _misbehaving(material, next(numbers), name, expected)
    while True:
        at, number = rng.randrange(changes), next(numbers)
        kind = rng.randrange(4)
        if kind == 0:
            size = rng.randrange(12_000)
            yield _disturbed(f"files of at most {size} bytes", material, number, expected, size)
        elif kind == 1:
            yield _disturbed(f"Ctrl-C at change {at}", material, number, expected, at, _stop)
        else:
            error, lasting = rng.choice(ERRORS), rng.random() < 0.5
            what = f"{errno.errorcode[error]} at change {at}{' and on' if lasting else ''}"
            act = _failing(error)
            yield _disturbed(what, material, number, expected, at, act, lasting)


def _stop(event: str, path: str) -> None:
    """Interrupt as Ctrl-C does: in the main thread, and not in the place of a removal."""
    if event != "os.remove" and threading.current_thread() is threading.main_thread():
        signal.raise_signal(signal.SIGINT)


def _failing(error: int) -> Injected:
    def fail(event: str, path: str) -> None:
        raise OSError(error, os.strerror(error), path)

    return fail


def _disturbed(
    what: str,
    material: Material,
    number: int,
    expected: list[str],
    at: int,
    act: Injected | None = None,
    lasting: bool = False,
) -> Trial:
    """Return the trial of a run with a fault, after which it is started again."""

    def run() -> Outcome:
        tried = Run(material, number)
        fault = small_files(at) if act is None else injected(str(tried.out), at, act, lasting)
        try:
            with fault:
                first = tried.here()
        except Hung:
            return Outcome("hung", "it did not end")
        except BaseException as error:
            return Outcome("traceback", f"{type(error).__name__}: {error}")
        try:
            again = tried.here()
        except Hung:
            return Outcome("hung", "the run that was started again did not end")
        wrong = difference(tried.facts(), expected)
        left = set(leftovers(tried.out)) - _unremovable
        tried.removed()
        if "Traceback" in first.err:
            return Outcome("traceback", first.err.strip().split("\n")[-1])
        if first.status not in (0, 1, 2, 130):
            return Outcome("wrong", f"status {first.status}")
        if again.status or wrong:
            said = (first.err.strip() or first.out.strip()).split("\n")[-1]
            return Outcome("wrong", f"then status {again.status}, {wrong}; it said: {said}")
        return Outcome("wrong", f"left: {sorted(left)}") if left else Outcome("accepted")

    return Trial(what, run)


def _misbehaving(material: Material, number: int, name: str, expected: list[str]) -> Trial:
    """Return the trial of a run with a plug-in, which may fail by itself alone."""

    def run() -> Outcome:
        tried = Run(material, number, (plug_ins.spec(name), *ESTIMATORS))
        folder = os.getcwd()
        try:
            first = tried.here()
        except Hung:
            return Outcome("hung", "it did not end")
        except BaseException as error:
            return Outcome("traceback", f"{type(error).__name__}: {error}"[:300])
        finally:
            os.chdir(folder)
        wrong = difference(tried.facts(*ESTIMATORS), expected)
        tried.removed()
        if wrong or first.status != (1 if name in plug_ins.RAISING else 0):
            said = first.err.strip().split("\n")[-1][:300]
            return Outcome("wrong", f"status {first.status}, {wrong or 'rows right'}: {said}")
        printed = {each for each in first.out + first.err if not each.isprintable()} - {"\n"}
        if printed:
            return Outcome("wrong", f"unseen characters {sorted(printed)!r}")
        return Outcome("accepted")

    return Trial(f"plug-in {name}", run)
