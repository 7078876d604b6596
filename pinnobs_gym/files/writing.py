"""Writing of whole files and folders, under a temporary name that nobody can predict."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_SHOWN = 40
"""Largest number of characters of a name that are part of a temporary one."""


_NO_SPACE = frozenset(
    getattr(errno, name) for name in ("ENOSPC", "EDQUOT", "EROFS") if hasattr(errno, name)
)
"""Errors that say that nothing more can be written: the disk or the quota is full, or the disk may
only be read."""


class CannotWrite(ValueError):
    """Something could not be written: the disk is full, or the place does not allow it. What was
    there before is unchanged."""


@contextmanager
def replacing(path: Path, *, durable: bool = False, create_folder: bool = True) -> Iterator[Path]:
    """Yield an empty temporary file to write to. It is renamed to ``path`` at the end of the
    context, or deleted if the context ends with an error. A device or a pipe, which nothing can
    replace, is yielded itself.

    Args:
        path: the file.
        durable: wait until the disk has the file.
        create_folder: create the folder of the file if there is none.

    Raises:
        CannotWrite: in one line, if the file cannot be written.
    """
    special = path.exists() and not path.is_file() and not path.is_dir()
    temporary = path if special else temporary_name(path)
    try:
        if create_folder:
            path.parent.mkdir(parents=True, exist_ok=True)
        if not special:
            _create(temporary)
    except OSError as error:
        raise cannot_write(path, error) from None
    try:
        yield temporary
        if not special:
            _rename(temporary, path, durable)
    except OSError as error:
        if not _concerns(error, path, temporary):
            raise
        raise cannot_write(path, error) from None
    finally:
        if not special:
            with suppress(OSError):
                temporary.unlink(missing_ok=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a temporary folder to write to. It is renamed to ``path`` at the end of the context, in
    place of an empty folder, or deleted with its files if the context ends with an error.

    Raises:
        CannotWrite: in one line, if the folder or a file in it cannot be written.
    """
    temporary = temporary_name(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.mkdir()
    except OSError as error:
        raise cannot_write(path, error) from None
    try:
        yield temporary
        if path.exists():
            path.rmdir()
        os.replace(temporary, path)
    except OSError as error:
        if not _concerns(error, path, temporary):
            raise
        raise cannot_write(path, error) from None
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def noticing_full_disks() -> Iterator[None]:
    """Raise an error of the system that says that nothing more can be written as `CannotWrite`, of
    whatever library it comes."""
    try:
        yield
    except OSError as error:
        if error.errno not in _NO_SPACE:
            raise
        raise CannotWrite(f"cannot write: {' '.join(str(error).split())}") from None


def temporary_name(path: Path) -> Path:
    """Return a path beside another one that nobody can predict."""
    return path.with_name(f".{path.name[:_SHOWN]}.{secrets.token_hex(16)}")


def cannot_write(path: Path, error: OSError) -> CannotWrite:
    """Return the error of one line that says that a path cannot be written, and why."""
    return CannotWrite(f"cannot write {path}: {' '.join(str(error.strerror or error).split())}")


def check_writable(folder: Path) -> None:
    """Create a folder if needed, and check that a file can be created in it.

    Raises:
        CannotWrite: in one line, if the folder cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = temporary_name(folder / "probe")
        _create(probe)
        probe.unlink()
    except OSError as error:
        raise CannotWrite(f"cannot write to folder {folder}: {error.strerror or error}") from None


def _create(path: Path) -> None:
    """Create an empty file. It is an error if there is anything of this name, also a link."""
    os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))


def _concerns(error: OSError, path: Path, temporary: Path) -> bool:
    """Return whether an error is of what is written, and not of another file that is read
    meanwhile. A write to a full disk names no file."""
    if not isinstance(error.filename, str | os.PathLike):
        return True
    named = Path(error.filename)
    return named == path or temporary in (named, *named.parents)


def _rename(temporary: Path, path: Path, durable: bool) -> None:
    """Give a complete file its name; wait until the disk has both if ``durable``."""
    if durable:
        with temporary.open("r+b") as file:
            os.fsync(file.fileno())
    os.replace(temporary, path)
    if durable:
        _sync_folder(path.parent)


def _sync_folder(folder: Path) -> None:
    """Wait until the disk has the names in a folder, where the system can."""
    with suppress(OSError):  # Windows opens no folder, and some network file systems sync none
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)
