"""Files that processes of several machines append to."""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_THREADS = threading.Lock()
"""A file's lock keeps other processes out; this one, the other threads of this process."""


@contextmanager
def locked(path: Path, *, make: bool = True) -> Iterator[int]:
    """The descriptor of a file that nobody else has locked meanwhile; what is written goes to its
    end. It is made if it is not there, or else that is an error.

    Raises:
        OSError: if the file cannot be opened or locked.
    """
    with _THREADS:  # closing any descriptor of a file gives up a process's lock on it
        flags = os.O_RDWR | os.O_APPEND | (os.O_CREAT if make else 0)
        descriptor = os.open(path, flags, 0o644)
        try:
            fcntl.lockf(descriptor, fcntl.LOCK_EX)  # until the file is closed
            yield descriptor
        finally:
            os.close(descriptor)


def write_whole(descriptor: int, data: bytes, size: int) -> None:
    """Write at the end of a locked file of that size, all or nothing.

    Raises:
        OSError: if it does not fit; the file is as it was.
    """
    try:
        written = os.write(descriptor, data)
        if written < len(data):
            raise OSError(f"only {written} of {len(data)} bytes fitted")
    except BaseException:
        os.ftruncate(descriptor, size)
        raise
