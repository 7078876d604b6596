"""Files that processes of several machines append to."""

from __future__ import annotations

import fcntl
import json
import math
import os
import threading
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    pass

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


def json_line(values: Mapping[str, Any]) -> bytes:
    """One line of JSON, with null where a number is not finite."""
    encoded = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
    return json.dumps(encoded).encode() + b"\n"


def append_lines(path: Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Append objects to a file of JSON lines, all or none of them, under a lock, and on a line of
    their own where the file ends in half a line.

    Raises:
        ValueError: in one line, if the file cannot be written; what it held is untouched.
    """
    data = b"".join(map(json_line, objects))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with locked(path) as descriptor:
            size = os.fstat(descriptor).st_size
            ends = not size or os.pread(descriptor, 1, size - 1) == b"\n"
            write_whole(descriptor, data if ends else b"\n" + data, size)
    except OSError as error:
        raise ValueError(f"cannot write to {path}: {error}") from None


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


class replacing:
    """A context whose value is a temporary path that becomes the given one if all goes well, so
    that a file is whole or not there."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f".{path.name}.{os.getpid()}")

    def __enter__(self) -> Path:
        """The temporary path.

        Raises:
            ValueError: in one line, if nothing can be written there.
        """
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._temporary.touch()
        except OSError as error:
            raise ValueError(f"cannot write {self._path}: {error}") from None
        return self._temporary

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            os.replace(self._temporary, self._path)
        else:
            self._temporary.unlink(missing_ok=True)


def check_writable(folder: Path) -> None:
    """Make a folder.

    Raises:
        ValueError: in one line, if nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".write-{os.getpid()}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write to folder {folder}: {error}") from None
