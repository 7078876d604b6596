"""Appending to files that several processes share, and locks."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

from filelock import BaseFileLock, FileLock, Timeout

from pinnobs_gym.files.writing import cannot_write

POLL = 0.01
"""Seconds between two attempts to lock a file that another process has locked."""


def append_lines(path: Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Append objects to a file of JSON lines, all or none of them, under a lock. They start on a
    new line if the file ends in an incomplete one. The file and its folder are created as needed.

    Raises:
        CannotWrite: in one line, if the file cannot be written; its content is unchanged.
    """
    data = b"".join(map(json_line, objects))
    try:
        with locked(path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            ends = file.read(1) in (b"", b"\n")
            write_whole(file, data if ends else b"\n" + data)
    except OSError as error:
        raise cannot_write(path, error) from None


def json_line(values: Mapping[str, Any]) -> bytes:
    """Return one line of JSON, with null for numbers that are not finite."""
    try:
        text = json.dumps(values, allow_nan=False)
    except ValueError:
        text = json.dumps(_finite(values), allow_nan=False)
    return text.encode() + b"\n"


def _finite(value: Any) -> Any:
    """Return a value with None in place of numbers that are not finite."""
    if isinstance(value, Mapping):
        return {name: _finite(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextmanager
def locked(path: Path) -> Iterator[FileIO]:
    """Yield a file opened for reading and appending, under an exclusive lock. The file and its
    folder are created as needed.

    Raises:
        OSError: if the file cannot be opened or locked.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _lock(path).acquire(poll_interval=POLL), FileIO(path, "a+") as file:
        yield file


def write_whole(file: FileIO, data: bytes, *, durable: bool = True) -> None:
    """Append to a file that nobody else writes to now, all or nothing. If ``durable``, wait until
    the disk has it.

    Raises:
        OSError: if not all data can be written. The file is unchanged, unless nothing can be
            written to it at all.
    """
    size = file.seek(0, os.SEEK_END)
    try:
        left = memoryview(data)
        while left:  # of what does not fit, a first write takes a part, and the next says why
            written = file.write(left)
            if not written:
                raise OSError(f"only {len(data) - len(left)} of {len(data)} bytes fitted")
            left = left[written:]
        if durable:
            os.fsync(file.fileno())
    except BaseException:
        with suppress(OSError):  # the first error says more
            file.truncate(size)
        raise


@contextmanager
def holding(path: Path) -> Iterator[None]:
    """Hold a path, which need not exist, for the duration of the context, or until the process
    ends. Other processes can check this by `is_held`.

    Raises:
        OSError: if the path cannot be locked.
    """
    lock = _lock(path)
    try:
        with lock.acquire(poll_interval=POLL):
            yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)


def is_held(path: Path) -> bool:
    """Return whether a live process is `holding` a path. A lock file left by a dead process is
    deleted."""
    lock = _lock(path)
    try:
        with lock.acquire(blocking=False):
            pass
    except Timeout:
        return True
    Path(lock.lock_file).unlink(missing_ok=True)
    return False


def _lock(path: Path) -> BaseFileLock:
    return FileLock(path.with_name(f".{path.name.lstrip('.')}.lock"))
