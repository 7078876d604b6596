"""The folder that keeps compiled libraries.

It is ``kernels`` in the user's cache folder for this package: below ``$PINNOBS_CACHE``,
``$XDG_CACHE_HOME/pinnobs-gym``, or where the system keeps such files. Code is loaded from it only
if the folder and the file belong to this user and nobody else can write to them. Where it cannot be
used, a temporary folder of this process stands in for it, and the log says so once.
"""

from __future__ import annotations

import atexit
import json
import os
import re
import shutil
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

from pinnobs_gym.files.writing import CannotWrite, replacing
from pinnobs_gym.simulation.notices import say_once

MOST_BYTES, MOST_FILES = 200 * 2**20, 500
"""Beyond these, the libraries that were not used for the longest time are removed."""
LIBRARY, ABOUT, PLANT, FAILED = ".so", ".json", ".plant", ".failed"
"""Endings of a library, of what is told of it, of an entry of the index, and of a failure."""
_OURS = re.compile(r"\.?[0-9a-f]{24}(\.so|\.json|\.plant|\.failed|\.lock)(\.[0-9a-f]{32})?")
"""Names of the files that are written here; those of incomplete ones are longer."""
WORK = "work-"
"""What the names of the folders begin with in which code is compiled."""
_ABANDONED = 3600.0
"""Age in s from which such a folder and incomplete files are those of a killed process."""
_chosen: dict[tuple[str, int], Path] = {}


def kernel_folder() -> Path:
    """Return the folder, which exists.

    Raises:
        OSError: if not even a temporary folder can be made.
    """
    try:
        wanted = _wanted()
    except RuntimeError as error:  # there is no home
        return _temporary("", str(error))
    key = str(wanted), os.getpid()
    if key not in _chosen:
        try:
            wanted.parent.mkdir(parents=True, exist_ok=True)
            wanted.mkdir(mode=0o700, exist_ok=True)
            probe = wanted / f"{WORK}{uuid4().hex}"
            reason = distrusted(wanted)
            if not reason:
                probe.mkdir()
                probe.rmdir()
        except OSError as error:
            reason = f"{wanted} cannot be written to: {error.strerror or error}"
        if reason:
            return _temporary(key[0], reason)
        _chosen[key] = wanted
    return _chosen[key]


def leave(reason: str) -> Path:
    """Return a temporary folder, which is used from now on, and say the reason once."""
    return _temporary(str(_wanted()), reason)


def _wanted() -> Path:
    given = os.environ.get("PINNOBS_CACHE")
    if given:
        return Path(given).expanduser().absolute() / "kernels"
    if os.environ.get("XDG_CACHE_HOME"):
        caches = Path(os.environ["XDG_CACHE_HOME"])
    elif sys.platform == "win32" and os.environ.get("LOCALAPPDATA"):
        caches = Path(os.environ["LOCALAPPDATA"])
    elif sys.platform == "darwin":
        caches = Path.home() / "Library" / "Caches"
    else:
        caches = Path.home() / ".cache"
    return caches.absolute() / "pinnobs-gym" / "kernels"


def _temporary(wanted: str, reason: str) -> Path:
    key = wanted, os.getpid()
    if key not in _chosen or _chosen[key] == Path(wanted):
        say_once(f"compiled code is kept for this process only: {reason}")
        _chosen[key] = Path(tempfile.mkdtemp(prefix="pinnobs-kernels-"))
        atexit.register(_remove, _chosen[key], os.getpid())
    return _chosen[key]


def _remove(folder: Path, process: int) -> None:
    if os.getpid() == process:  # not in a fork of it
        shutil.rmtree(folder, ignore_errors=True)


def distrusted(path: Path) -> str:
    """Return why an existing file or folder is not trusted, an empty text if it is: it is a link,
    or belongs to another user, or others can write to it.

    Raises:
        OSError: if there is no such file.
    """
    found = path.lstat()
    if stat.S_ISLNK(found.st_mode):
        return f"{path} is a link"
    if os.name == "nt":
        return ""  # the folders of a user are closed to others
    if found.st_uid != os.geteuid():
        return f"{path} belongs to another user"
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others can write to {path}"
    return ""


def write_json(path: Path, content: Any) -> None:
    """Write a file whole or, if the folder does not allow it, not at all."""
    with suppress(CannotWrite), replacing(path, create_folder=False) as temporary:
        temporary.chmod(0o600)  # for this user alone, whatever is usual for new files
        temporary.write_text(json.dumps(content), encoding="utf-8")


def read_json(path: Path) -> Any:
    """Return the content of a file, None if there is none that is whole and trusted."""
    try:
        return None if distrusted(path) else json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


def trim(folder: Path) -> None:
    """Remove the libraries beyond the allowed size, those unused for longest first, with what
    belongs to them, and what killed processes left."""
    now, used = time.time(), []
    for path, found in _files(folder):
        age = now - found.st_mtime
        if path.name.startswith(WORK):
            if age > _ABANDONED:
                shutil.rmtree(path, ignore_errors=True)
        elif path.suffix == LIBRARY:
            used.append((found.st_mtime, found.st_size, path))
        elif path.suffix not in (ABOUT, PLANT) and age > _ABANDONED:
            _unlink(path)  # failures, locks that nobody holds, incomplete files
    total = 0
    for number, (_, size, path) in enumerate(sorted(used, reverse=True)):
        total += size
        if total > MOST_BYTES or number >= MOST_FILES:
            _unlink(path)
    left = {path.stem for path, _ in _files(folder) if path.suffix == LIBRARY}
    entries = []
    for path, found in _files(folder):
        if path.suffix == ABOUT and path.stem not in left:
            _unlink(path)
        if path.suffix == PLANT:
            library = (read_json(path) or {}).get("library")
            if library is not None and library not in left:
                _unlink(path)
            else:
                entries.append((found.st_mtime, path))
    for _, path in sorted(entries, reverse=True)[2 * MOST_FILES :]:
        _unlink(path)


@dataclass(frozen=True)
class Kept:
    """A library that is kept."""

    size: int
    """Its size in bytes."""
    used: float
    """When it was used last, in s since 1970."""
    about: dict[str, str]
    """Its ``plant``, ``template``, ``compiler`` and ``processor``, as far as they are known."""


def kept_libraries(folder: Path) -> list[Kept]:
    """Return the libraries of the folder, those used last first."""
    found = []
    for path, stat_of in _files(folder):
        if path.suffix == LIBRARY:
            about = read_json(path.with_suffix(ABOUT))
            told = about if isinstance(about, dict) else {}
            found.append(Kept(stat_of.st_size, stat_of.st_mtime, told))
    return sorted(found, key=lambda kept: -kept.used)


def clear(folder: Path) -> int:
    """Remove all that was written to the folder, nothing else, and return the number of
    libraries."""
    count = 0
    for path, _ in list(_files(folder)):
        if path.name.startswith(WORK):
            shutil.rmtree(path, ignore_errors=True)
        elif _unlink(path):
            count += path.suffix == LIBRARY
    return count


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the files and folders that were written here."""
    with suppress(OSError):
        for path in sorted(folder.iterdir()):
            is_work = path.name.startswith(WORK)
            with suppress(OSError):
                found = path.lstat()
                is_folder = stat.S_ISDIR(found.st_mode)
                if is_folder if is_work else not is_folder and _OURS.fullmatch(path.name):
                    yield path, found


def _unlink(path: Path) -> bool:
    try:
        path.unlink()
    except OSError:  # another process removed it or, on Windows, has loaded it
        return False
    return True
