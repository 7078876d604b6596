"""A process that ends the workers of a client which is killed and thus cannot end them itself.

It is run as a file, and imports nothing slow. It reads ids of workers, one per line, from its
standard input, whose other end is held by the client alone. When the client ends in any way, so
does the input. The workers ever named are then killed, with all that they have started.
"""

from __future__ import annotations

import os
import signal
import sys


def guard() -> None:
    """Wait for the end of the client, and kill its workers."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    groups: dict[str, None] = {}
    for line in sys.stdin:
        sign, group = line[0], line[1:].strip()
        if sign == "+":
            groups[group] = None
        else:
            groups.pop(group, None)
    for group in groups:
        try:
            os.killpg(int(group), signal.SIGKILL)
        except OSError:  # it has ended
            continue


if __name__ == "__main__":
    guard()
