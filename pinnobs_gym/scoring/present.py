"""The episodes that a rows file holds, remembered from one appending to the next."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable
from io import FileIO
from pathlib import Path
from typing import Any, TypeAlias

Key: TypeAlias = tuple[Any, ...]
"""What identifies a scored episode; its last value is the episode's number."""

_CHECKED = 64
"""Number of bytes before the end of what was read that are compared, to recognise the file."""
_MOST_FILES = 8
"""Largest number of files that are remembered."""


class Present:
    """The keys of the scored episodes in a file. Each update reads what was appended since the one
    before, by whichever process; a file that is shorter, or is another one, is read anew."""

    def __init__(self) -> None:
        self._forget()

    def _forget(self) -> None:
        self._file: tuple[int, int] | None = None
        self._end = 0  # of the last whole line that was read
        self._before = b""  # the bytes before that end
        # Episodes by the other values of their keys, which many rows have in common.
        self._episodes: defaultdict[Key, set[Any]] = defaultdict(set)
        self._last: Key | None = None  # of a last line without newline

    def __contains__(self, key: Key) -> bool:
        return key == self._last or key[-1] in self._episodes.get(key[:-1], ())

    def update(self, file: FileIO, key_in: Callable[[bytes], Key | None]) -> None:
        """Read what is new in a locked file.

        Args:
            file: the file, opened for reading.
            key_in: returns the key of the scored episode in a line; None for any other line.
        """
        facts = os.fstat(file.fileno())
        found = facts.st_dev, facts.st_ino
        file.seek(self._end - len(self._before))
        data = file.readall()
        if found != self._file or not data.startswith(self._before):
            self._forget()
            self._file = found
            file.seek(0)
            data = file.readall()
        whole, newline, tail = data[len(self._before) :].rpartition(b"\n")
        for line in whole.split(b"\n"):
            key = key_in(line)
            if key is not None:
                self._episodes[key[:-1]].add(key[-1])
        self._last = key_in(tail)
        self._end += len(whole) + len(newline)
        self._before = data[: len(data) - len(tail)][-_CHECKED:]


_PRESENT: dict[str, Present] = {}
"""The files that were appended to last, by their absolute paths."""


def present_in(path: Path, file: FileIO, key_in: Callable[[bytes], Key | None]) -> Present:
    """Return the episodes in a locked file; see `Present.update`."""
    name = os.path.abspath(path)
    present = _PRESENT.pop(name, None) or Present()
    present.update(file, key_in)
    _PRESENT[name] = present  # the latest last
    while len(_PRESENT) > _MOST_FILES:
        del _PRESENT[next(iter(_PRESENT))]
    return present
