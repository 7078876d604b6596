"""A worker process of this machine: how it begins, and how it ends with all that it started.

On POSIX systems a worker leads a process group, so that the processes that a plug-in has started
are ended with it, and a `Guard` ends it if the client is killed.
"""

from __future__ import annotations

import atexit
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_GUARD = Path(__file__).with_name("guard_process.py")


def begin() -> None:
    """Prepare this process: it ignores Ctrl-C, since the client handles it and stops workers; it
    prints to standard error, as standard output is for results; and it reads no input."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    with suppress(OSError):  # standard error may be closed
        os.dup2(2, 1)
    if os.name == "posix":
        with suppress(OSError):  # it leads one already
            os.setpgid(0, 0)


def end_group(process: int) -> None:
    """Kill a worker, and the processes that it has started, also if it is dead itself. Does nothing
    on Windows, where loky does this."""
    if os.name == "posix":
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(process, signal.SIGKILL)


class Guard:
    """Ends workers if this process is killed; see `pinnobs_gym.leaderboard.jobs.guard_process`."""

    def __init__(self) -> None:
        self._watched: set[int] = set()
        self._process: subprocess.Popen[bytes] | None = None
        if os.name == "posix":
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", str(_GUARD)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                start_new_session=True,
                cwd="/",
            )
            atexit.register(self._close)

    def watch(self, process: int) -> None:
        """Let a worker end with this process."""
        self._watched.add(process)
        self._tell(f"+{process}\n")

    def forget(self, process: int) -> None:
        """Let a worker, which has ended, be."""
        self._watched.discard(process)
        self._tell(f"-{process}\n")

    def _tell(self, line: str) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):  # it was killed
                self._process.stdin.write(line.encode())
                self._process.stdin.flush()

    def _close(self) -> None:
        """End the guard; by then all workers have ended."""
        for process in list(self._watched):
            self.forget(process)
        if self._process is not None and self._process.stdin is not None:
            with suppress(OSError):
                self._process.stdin.close()
            self._process.wait()
