"""Stored scores: one JSON object per line and episode, appended whole, read back and resumed."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeAlias

from pinnobs_gym.metrics import OPTIONAL_SCORES, SCORES

SCHEMA = 2
"""Version of the row format."""

Row: TypeAlias = dict[str, Any]
"""One scored episode. Its keys:

- ``schema``: version of this format.
- ``env_id``, ``setup``, ``condition``, ``episode_seed``: the episode.
- ``ranked``: whether this is the condition that the system is ranked under; ``nx``: how many states
  it has.
- ``estimator``, ``track``, ``knows``, ``options``, ``config_hash``: the estimator, its track, what
  it is told, its settings, and a hash of these and of its model and training.
- ``training``, ``training_seed``: how it was trained, for learned ones: seconds, config, ...
- the scores of `pinnobs_gym.metrics.score` by name, ``null`` standing for infinity.
- those of `pinnobs_gym.metrics.OPTIONAL_SCORES` that apply, in the same way; those that do not are
  None here and absent in the file.
- ``us_per_step``: CPU microseconds per step and episode, in the batch it was run in.
- ``batch``: the size of that batch.
- ``versions``, ``date``: of the packages, and when it was run (UTC).
"""

KEY = (
    "env_id",
    "setup",
    "condition",
    "estimator",
    "config_hash",
    "training_seed",
    "episode_seed",
)
"""The fields that name a row; no two rows of a file share them."""


def key(row: Row) -> tuple[Any, ...]:
    """What names a row."""
    return tuple(row[name] for name in KEY)


def append(path: Path, rows: Iterable[Row]) -> None:
    """Append rows to a file in one write, so that processes may share it and a kill leaves no half
    line. If the file ends in one all the same, the rows begin on a line of their own.

    Raises:
        ValueError: in one line, if the file cannot be written; what it held is untouched.
    """
    data = "".join(json.dumps(_encoded(row)) + "\n" for row in rows).encode()
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            size = os.fstat(descriptor).st_size
            if size and os.pread(descriptor, 1, size - 1) != b"\n":
                data = b"\n" + data
            written = os.write(descriptor, data)
            if written < len(data):
                raise OSError(f"only {written} of {len(data)} bytes fitted")
        finally:
            os.close(descriptor)
    except OSError as error:
        raise ValueError(f"cannot write rows to {path}: {error}") from None


def read(path: Path) -> list[Row]:
    """The rows of a file, in its order; none if there is no such file.

    Raises:
        ValueError: in one line that names the file and the line, if one is not a whole row of this
            schema, or contradicts an earlier one.
    """
    if not path.exists():
        return []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read rows from {path}: {error}") from None
    rows: dict[tuple[Any, ...], tuple[int, Row]] = {}
    for number, line in enumerate(lines, 1):
        row = _decoded(path, number, line)
        name = key(row)
        if name in rows and any(rows[name][1][s] != row[s] for s in (*SCORES, "diverged")):
            raise ValueError(
                f"{path}, lines {rows[name][0]} and {number}, give different scores of the same "
                f"episode: {dict(zip(KEY, name, strict=True))}"
            )
        rows.setdefault(name, (number, row))
    return [row for _, row in rows.values()]


def read_all(paths: Iterable[Path]) -> list[Row]:
    """The rows of several files, each once.

    Raises:
        ValueError: in one line, if there is no such file, and as `read` and where two files give
            different scores of an episode.
    """
    found: dict[tuple[Any, ...], tuple[Path, Row]] = {}
    for path in paths:
        if not path.exists():
            raise ValueError(f"there is no rows file {path}")
        for row in read(path):
            name = key(row)
            first, earlier = found.setdefault(name, (path, row))
            if any(earlier[score] != row[score] for score in (*SCORES, "diverged")):
                raise ValueError(
                    f"{first} and {path} give different scores of the same episode: "
                    f"{dict(zip(KEY, name, strict=True))}"
                )
    return [row for _, row in found.values()]


def _encoded(row: Row) -> Row:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in row.items()
        if not (value is None and name in OPTIONAL_SCORES)
    }


def _decoded(path: Path, number: int, line: str) -> Row:
    try:
        row = json.loads(line)
    except json.JSONDecodeError:
        row = None
    if not isinstance(row, dict):
        raise ValueError(
            f"{path}, line {number}, is cut off or is not a row: {line[:40]!r}...; delete that "
            f"line and run again, and only what it held is run anew"
        )
    if row.get("schema") != SCHEMA:
        raise ValueError(
            f"{path}, line {number}: rows of schema {row.get('schema')!r}; expected {SCHEMA}: move "
            f"the file away and run again"
        )
    missing = [name for name in (*KEY, *SCORES, "diverged", "ranked", "nx") if name not in row]
    if missing:
        raise ValueError(f"{path}, line {number}: a row without {', '.join(missing)}")
    for name in SCORES:
        row[name] = math.inf if row[name] is None else row[name]
    for name in OPTIONAL_SCORES:
        row[name] = math.inf if name in row and row[name] is None else row.get(name)
    return row
