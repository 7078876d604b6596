"""Trials of files that are read by a function."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random

from hardening.mutations import BINARY, Change, mutated
from hardening.trial import Trial, call, written


def damaged(
    rng: Random,
    path: Path,
    good: bytes,
    read: Callable[[], str],
    changes: tuple[Change, ...] = BINARY,
) -> Iterator[Trial]:
    """Yield trials of a damaged file, which is refused by its name, or read as if it were not.

    Args:
        rng: random numbers.
        path: where the file is written.
        good: the content of a valid file.
        read: reads the file, and returns a digest of what it holds.
        changes: the changes that are made.
    """
    written(path, good)
    expected = read()

    def tried(data: bytes) -> str:
        written(path, data)
        return "" if read() == expected else "its content was accepted though it is another"

    while True:
        what, data = mutated(rng, good, changes)
        yield call(f"{path.name}: {what}", lambda d=data: tried(d), [str(path)])
