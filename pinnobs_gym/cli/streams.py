"""The standard streams of a command: consoles of few characters, pipes whose reader has left."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable
from io import TextIOWrapper
from typing import TextIO

PIPE_CLOSED = 141
"""Exit status of a command whose output nobody reads any more: that of a process which SIGPIPE
ends."""


def print_anything() -> None:
    """Replace what the output cannot show: redirected output on Windows has few characters."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def until_pipe_closes(command: Callable[[], int]) -> int:
    """Run a command and write what it has printed. Returns its exit status, or `PIPE_CLOSED`,
    without a message, if the reader of its output has left, as ``head`` does.

    Raises:
        BrokenPipeError: if a connection of the command was closed rather than its output.
    """
    try:
        status = command()
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        closed = [stream for stream in (sys.stdout, sys.stderr) if _has_no_reader(stream)]
        if not closed:
            raise
        with open(os.devnull, "wb") as nowhere:  # for what Python writes at the end of the process
            for stream in closed:
                os.dup2(nowhere.fileno(), stream.fileno())
        return PIPE_CLOSED


def _has_no_reader(stream: TextIO) -> bool:
    """Return whether a stream is a pipe whose reader has left."""
    try:
        poll = select.poll()
        poll.register(stream.fileno(), select.POLLOUT)
        return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    except (AttributeError, OSError, ValueError):  # without such a call, or a stream without a file
        return False
