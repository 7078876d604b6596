"""Signals that ask a run to stop: Ctrl-C, SIGTERM and SIGHUP.

By default SIGTERM ends a process at once, and its worker processes live on. Within `stoppable` it
raises `Stopped` instead, so that everything that was started is ended. Jobs in the current process
run within `interruptible`, by which the code of a plug-in cannot swallow the request.
"""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

GRACE = 3.0
"""Seconds after which a process that does not react to a signal ends in any case."""
_HANGUP = getattr(signal, "SIGHUP", signal.SIGTERM)  # Windows has none
ENDING = tuple(dict.fromkeys((signal.SIGTERM, _HANGUP)))
"""The signals that `stoppable` handles."""


class Stopped(KeyboardInterrupt):
    """A signal asks the process to end.

    Args:
        number: the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.status = 128 + number
        """Exit status of the process, by the convention of shells."""


def stop_line(stop: KeyboardInterrupt) -> str:
    """Return what a command prints when it is stopped by a signal."""
    by = f" by {stop}" if isinstance(stop, Stopped) else ""
    return f"pinnobs: stopped{by}; what was written is kept"


def _stop(number: int, frame: object) -> NoReturn:
    for each in ENDING:  # a second signal must not interrupt the cleanup
        if signal.getsignal(each) is _stop:
            signal.signal(each, signal.SIG_IGN)
    raise Stopped(number)


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise `Stopped` in the main thread when a signal asks the process to end.

    A signal that is ignored, as SIGHUP is under ``nohup``, or that has a handler stays so; without
    effect outside the main thread. Python runs handlers between its own instructions only, so that
    code in another language delays them: after `GRACE` seconds the process ends nevertheless.
    """
    in_main = threading.current_thread() is threading.main_thread()
    taken = [n for n in ENDING if in_main and signal.getsignal(n) is signal.SIG_DFL]
    if not taken:
        yield
        return
    reading, writing = socket.socketpair()
    writing.setblocking(False)
    before = signal.set_wakeup_fd(writing.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=_end_after_grace, args=(reading,), daemon=True).start()
    for number in taken:
        signal.signal(number, _stop)
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, signal.SIG_DFL)
        signal.set_wakeup_fd(before)
        with suppress(OSError):  # the thread ends, also if a forked process has the socket, too
            writing.shutdown(socket.SHUT_RDWR)
        writing.close()


def _end_after_grace(reading: socket.socket) -> None:
    """End the process `GRACE` seconds after a signal of `ENDING` is received as a byte, unless the
    connection is closed before."""
    with reading:
        while received := reading.recv(1):
            if received[0] in ENDING:
                break
        else:
            return
        deadline = time.monotonic() + GRACE
        try:
            while (left := deadline - time.monotonic()) > 0:
                reading.settimeout(left)
                if not reading.recv(1):
                    return
        except TimeoutError:
            pass
    with suppress(Exception):
        print(stop_line(Stopped(received[0])), file=sys.stderr, flush=True)
    os._exit(128 + received[0])


class _Interrupted(BaseException):
    """A signal during a job. It differs from KeyboardInterrupt, on which trainers return their
    result so far, which must not be scored."""


_OURS: tuple[Any, ...] = (signal.default_int_handler, _stop)
"""The handlers that `interruptible` postpones."""


@contextmanager
def interruptible() -> Iterator[bool]:
    """Interrupt the code of the context when a signal asks to stop, and stop after it, whatever the
    code made of the interruption.

    Yields whether Ctrl-C is handled in this way, in which case a KeyboardInterrupt within the
    context is not the user's.
    """
    in_main = threading.current_thread() is threading.main_thread()
    numbers = (signal.SIGINT, *ENDING) if in_main else ()
    handlers = {n: handler for n in numbers if (handler := signal.getsignal(n)) in _OURS}
    received: list[int] = []

    def interrupt(number: int, frame: object) -> NoReturn:
        received.append(number)
        raise _Interrupted

    for number in handlers:
        signal.signal(number, interrupt)
    try:
        # Workers ignore Ctrl-C, and threads do not get it.
        yield signal.SIGINT in handlers or not in_main or _ignored(signal.SIGINT)
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if received:
            handler: Any = handlers[signal.Signals(received[0])]
            handler(received[0], None)


def _ignored(number: int) -> bool:
    return signal.getsignal(number) is signal.SIG_IGN


@contextmanager
def ignoring_ctrl_c() -> Iterator[None]:
    """Ignore Ctrl-C for a moment, so that processes started within ignore it, too."""
    in_main = threading.current_thread() is threading.main_thread()
    before = signal.getsignal(signal.SIGINT) if in_main else None
    if before is None or _ignored(signal.SIGINT):
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
