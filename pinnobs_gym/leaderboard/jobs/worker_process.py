"""A worker process of this machine: how it begins, and how it ends with all that it started.

On POSIX systems a worker leads a process group, so that the processes that a plug-in has started
are ended with it. A worker also ends within a second after its client was killed, which cannot end
it then.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import suppress

LOOK = 0.5
"""Seconds between two checks that the client lives."""


def begin(client: int) -> None:
    """Prepare this process, a child of the client: it ignores Ctrl-C, since the client handles it
    and stops workers; it prints to standard error, as standard output is for results; and it reads
    no input.

    Args:
        client: process id of the client.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    with suppress(OSError):  # standard error may be closed
        os.dup2(2, 1)
    if os.name == "posix":
        with suppress(OSError):  # it leads one already
            os.setpgid(0, 0)
        threading.Thread(target=_end_with, args=(client,), daemon=True).start()


def _end_with(client: int) -> None:
    """End this process group once the client is no longer its parent, which then was killed."""
    while os.getppid() == client:
        time.sleep(LOOK)
    os.killpg(0, signal.SIGKILL)


def end_group(process: int) -> None:
    """Kill a worker, and the processes that it has started, also if it is dead itself. Does nothing
    on Windows, where loky does this."""
    if os.name == "posix":
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process, signal.SIGKILL)
