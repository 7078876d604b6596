"""Atomic writing of files, also when several processes write them at once.

- `replacing` writes a new file under a temporary name and renames it when it is complete. Readers
  see either the old file or the new one.
- `check_writable` checks before a long computation that its results can be written.
- `locked` opens a file for appending by one process and thread at a time; `write_whole` then
  appends all of the data or nothing, and a full disk leaves the file unchanged. `append_lines` does
  both for JSON lines.
- `holding` and `is_held` tell whether the process that owns a path is alive.

A file ``name`` is locked through an empty file ``.name.lock`` beside it, since on Windows a locked
file cannot even be read. The lock is the operating system's (``flock``, or ``LockFileEx`` on
Windows; the package filelock uses either). It is released when a process ends in any way, so that a
killed process blocks nobody. It works between machines if their shared folder supports locks, as
NFS and SMB do. On a system without such locks, filelock uses a file with the id of the process that
created it, and recognises a dead process on the same machine.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from io import FileIO
from pathlib import Path
from typing import Any
from uuid import uuid4

from filelock import BaseFileLock, FileLock, Timeout

POLL = 0.01
"""Seconds between two attempts to lock a file that another process has locked."""


_LONGEST_NAME = 80
"""Largest length of a `file_name`, short enough for several in one path."""
_DEVICES = (f"{device}{number}" for device in ("com", "lpt") for number in range(10))
_RESERVED = frozenset({"con", "prn", "aux", "nul", *_DEVICES})
"""Names that Windows keeps for devices."""


def file_name(name: str) -> str:
    """Return a name as one part of a path. Different names stay different, up to upper and lower
    case: a name with unsafe characters, such as ``../a``, is spelt without them and with its
    hash."""
    safe = re.sub(r"[^\w.+-]", "_", name, flags=re.ASCII).strip(".")[:_LONGEST_NAME]
    if safe == name and safe.partition(".")[0].lower() not in _RESERVED:
        return safe
    return f"{safe}-{hashlib.sha256(name.encode()).hexdigest()[:8]}".lstrip("-")


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path to write to. It is renamed to ``path`` at the end of the context, or
    deleted if the context ends with an error. Folders are created as needed.

    Raises:
        ValueError: in one line, if the file cannot be written.
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
    """Create a folder if needed, and check that a file can be created in it.

    Raises:
        ValueError: in one line, if the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".write-{uuid4().hex}"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"cannot write to folder {folder}: {error}") from None


def append_lines(path: Path, objects: Iterable[Mapping[str, Any]]) -> None:
    """Append objects to a file of JSON lines, all or none of them, under a lock. They start on a
    new line if the file ends in an incomplete one. The file and its folder are created as needed.

    Raises:
        ValueError: in one line, if the file cannot be written; its content is unchanged.
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


def write_whole(file: FileIO, data: bytes) -> None:
    """Append to a locked file, all or nothing.

    Raises:
        OSError: if not all data can be written; the file is unchanged.
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
