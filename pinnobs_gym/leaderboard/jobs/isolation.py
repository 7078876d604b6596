"""What a job changes in its process is undone, so that the next job does not depend on it.

Restored are the working folder, the environment, the module path, the standard streams, signal
handlers and timers, the locale, the filters of warnings, NumPy's error handling and all other
context variables, the limit of recursion, the garbage collector, and torch's default type. The
global random generators of Python, NumPy and torch begin every job in the same state. Changes of
classes and modules, as by a plug-in that assigns a class attribute, cannot be undone.
"""

from __future__ import annotations

import gc
import io
import locale
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from typing import Any

import numpy as np

_SEED = 0
_TORCH_SEED = 67280421310721  # that with which torch begins when it is imported


class Leftovers:
    """What a job leaves running in its process."""

    running = False
    """Whether there are processes, or threads for which this process would wait at its end."""


@contextmanager
def isolated() -> Iterator[Leftovers]:
    """Undo what the code of the context changes in this process, see the module; end the processes
    that it forked.

    Yields what remains to be known of it, which is set at the end of the context.
    """
    left, process = Leftovers(), os.getpid()
    threads, children, parent = set(threading.enumerate()), _children(), _is_parent()
    with ExitStack() as stack:
        for part in (_streams, _signals, _random_states, _torch, _settings):
            stack.enter_context(part())
        try:
            yield left
        finally:
            if os.getpid() != process:  # a fork that the job did not end goes no further
                os._exit(0)
            for child in _children() - children:
                child.kill()
            new = set(threading.enumerate()) - threads
            left.running = any(not each.daemon for each in new)
            left.running |= not parent and _is_parent()


def _children() -> set[Any]:
    """Return the running processes that multiprocessing has started here."""
    module: Any = sys.modules.get("multiprocessing")
    return set() if module is None else set(module.active_children())


def _is_parent() -> bool:
    """Return whether this process has children of any kind, False where that is not known."""
    wait: Any = getattr(os, "waitid", None)
    if wait is None:
        return False
    try:
        wait(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


class _Uncloseable:
    """A stream that its users cannot close."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def close(self) -> None:
        """Do nothing."""


@contextmanager
def _streams() -> Iterator[None]:
    """Print to standard error, as standard output is for results; reopen what was closed."""
    before = {name: getattr(sys, name) for name in ("stdout", "stderr")}
    saved: dict[int, int] = {}
    for number in (1, 2):
        with suppress(OSError):  # it is closed from the start
            saved[number] = os.dup(number)
    if before["stderr"] is not None:
        sys.stdout = sys.stderr = _Uncloseable(before["stderr"])
    try:
        yield
    finally:
        for number, copy in saved.items():
            os.dup2(copy, number)
            os.close(copy)
        for number, (name, stream) in enumerate(before.items(), 1):
            if getattr(stream, "closed", False) and number in saved:
                raw: Any = io.FileIO(number, "wb", closefd=False)
                stream = io.TextIOWrapper(raw, errors="replace", write_through=True)
                setattr(sys, f"__{name}__", stream)
            setattr(sys, name, stream)


@contextmanager
def _signals() -> Iterator[None]:
    """Restore the handlers of signals, and stop a timer that was started."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    timer: Callable[..., Any] | None = getattr(signal, "setitimer", None)
    timed = timer is not None and any(signal.getitimer(signal.ITIMER_REAL))
    try:
        yield
    finally:
        if timer is not None and not timed:
            timer(signal.ITIMER_REAL, 0)
        for number, handler in handlers.items():
            if handler is not None and signal.getsignal(number) is not handler:
                signal.signal(number, handler)


@contextmanager
def _random_states() -> Iterator[None]:
    """Begin with the same state of the global random generators, and restore theirs."""
    states: Any = random.getstate(), np.random.get_state()  # noqa: NPY002
    random.seed(_SEED)
    np.random.seed(_SEED)  # noqa: NPY002
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])  # noqa: NPY002


@contextmanager
def _torch() -> Iterator[None]:
    """The same for torch, if it is imported, and for its default type."""
    torch: Any = sys.modules.get("torch")
    if not hasattr(torch, "get_default_dtype"):
        yield
        return
    state, kind = torch.get_rng_state(), torch.get_default_dtype()
    gradients = torch.is_grad_enabled()
    torch.manual_seed(_TORCH_SEED)
    try:
        yield
    finally:
        torch.set_rng_state(state)
        torch.set_default_dtype(kind)
        torch.set_grad_enabled(gradients)


@contextmanager
def _settings() -> Iterator[None]:
    """Restore the settings of the interpreter and of the process."""
    folder, environment, modules = _folder(), dict(os.environ), list(sys.path)
    limit, collects = sys.getrecursionlimit(), gc.isenabled()
    language = locale.setlocale(locale.LC_ALL)
    try:
        with warnings.catch_warnings():
            yield
    finally:
        if folder is not None and _folder() != folder:
            with suppress(OSError):  # it was deleted
                os.chdir(folder)
        if dict(os.environ) != environment:
            os.environ.clear()
            os.environ.update(environment)
        sys.path[:] = modules
        sys.setrecursionlimit(limit)
        (gc.enable if collects else gc.disable)()
        if locale.setlocale(locale.LC_ALL) != language:
            locale.setlocale(locale.LC_ALL, language)


def _folder() -> str | None:
    """Return the working folder, None if it was deleted."""
    try:
        return os.getcwd()
    except OSError:
        return None
