"""Files that are whole or not there, also where several processes write them at once.

- `replacing` writes a new file: under a temporary name, which becomes the file's own when it is
  whole. Readers see the old file or the new one.
- `check_writable` finds out before long work whether its results can be written.
- `locked` opens a file to be appended to, by one process and thread at a time; `write_whole` then
  appends all of the data or nothing, and a full disk leaves the file as it was. `append_lines` does
  both for JSON lines.
- `holding` and `is_held` tell whether the process still lives that something belongs to.

A file ``name`` is locked by an empty file ``.name.lock`` beside it: on Windows a file that is
locked itself cannot even be read. The lock is the operating system's (``flock``, or ``LockFileEx``
on Windows; the package filelock knows both), which gives it up when a process ends, however it
ends, so that a killed process blocks nobody. It holds between machines where their shared folder
passes locks on, as NFS and SMB do. On a system without such locks, filelock falls back on a file
that names the process that made it, and a dead one is recognised on the same machine.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any
from uuid import uuid4

from filelock import BaseFileLock, FileLock, Timeout

POLL = 0.01
"""Seconds between two attempts to lock a file that another process has locked."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A context whose value is a temporary path, to be written; it becomes ``path`` at the end of
    the context, or is deleted if that ends with an error. Folders are made as needed.

    Raises:
        ValueError: in one line, if nothing can be written there.
    """
    temporary = path.with_name(f".{path.name}.{uuid4().hex}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch()
    except OSError as error:
        raise ValueError(f"cannot write {path}: {error}") from None
    try:
        yield temporary
        try:
            os.replace(temporary, path)
        except OSError as error:
            raise ValueError(f"cannot write {path}: {error}") from None
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def check_writable(folder: Path) -> None:
    """Make a folder, and a file in it that is deleted again.

    Raises:
        ValueError: in one line, if nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".write-{uuid4().hex}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write to folder {folder}: {error}") from None


def append_lines(path: Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Append objects to a file of JSON lines, all or none of them, under a lock. They begin a line
    of their own if the file ends in half a line. The file and its folder are made as needed.

    Raises:
        ValueError: in one line, if the file cannot be written; what it held is untouched.
    """
    data = b"".join(map(json_line, objects))
    try:
        with locked(path) as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - 1, 0))
            ends = file.read(1) in (b"", b"\n")
            write_whole(file, data if ends else b"\n" + data)
    except OSError as error:
        raise ValueError(f"cannot write to {path}: {error}") from None


def json_line(values: Mapping[str, Any]) -> bytes:
    """One line of JSON, with null where a number is not finite."""
    encoded = {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
    return json.dumps(encoded).encode() + b"\n"


@contextmanager
def locked(path: Path) -> Iterator[FileIO]:
    """A file opened for reading anywhere and writing at its end, which nobody else has locked
    meanwhile. It and its folder are made as needed.

    Raises:
        OSError: if the file cannot be opened or locked.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _lock(path).acquire(poll_interval=POLL), FileIO(path, "a+") as file:
        yield file


def write_whole(file: FileIO, data: bytes) -> None:
    """Append to a locked file, all or nothing.

    Raises:
        OSError: if it does not fit; the file is as it was.
    """
    size = file.seek(0, os.SEEK_END)
    try:
        written = file.write(data)
        if written < len(data):
            raise OSError(f"only {written} of {len(data)} bytes fitted")
    except BaseException:
        file.truncate(size)
        raise


@contextmanager
def holding(path: Path) -> Iterator[None]:
    """Hold a path, whatever is there, for as long as this process lives and the context lasts, so
    that others can tell by `is_held`.

    Raises:
        OSError: if it cannot be locked.
    """
    lock = _lock(path)
    try:
        with lock.acquire(poll_interval=POLL):
            yield
    finally:
        Path(lock.lock_file).unlink(missing_ok=True)


def is_held(path: Path) -> bool:
    """Whether a process that lives is `holding` a path. What a dead one left of it is deleted."""
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
