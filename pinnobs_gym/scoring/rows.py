"""Stored scores: one JSON object per line and episode, appended whole, read back and resumed."""

from __future__ import annotations

import gc
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import FileIO
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.files import json_line, locked, write_whole
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES

SCHEMA = 3
"""Version of the row format."""

Row: TypeAlias = dict[str, Any]
"""One scored episode (``kind`` is ``score``). Its keys:

- ``schema``: version of this format.
- ``env_id``, ``setup``, ``condition``, ``episode_seed``: the episode.
- ``ranked``: whether this is the condition that the system is ranked under; ``nx``: how many states
  it has.
- ``estimator``, ``track``, ``knows``, ``options``, ``config_hash``: the estimator, its track, what
  it is told, its settings, and a hash of these and of its model and training.
- ``training``, ``training_seed``: how it was trained, for learned ones: seconds, config, ...
- the scores of `pinnobs_gym.scoring.metrics.score` by name, ``null`` standing for infinity.
- those of `pinnobs_gym.scoring.metrics.OPTIONAL_SCORES` that apply, in the same way; those that do
  not are None here and absent in the file.
- ``us_per_step``: CPU microseconds per step and episode, in the batch it was run in.
- ``batch``: the size of that batch.
- ``versions``, ``date``: of the packages, and when it was run (UTC).

Or a job of a leaderboard that failed (``kind`` is ``failure``), or one that failed before and then
went well (``recovery``), of which these are kept:

- ``schema``, ``env_id``, ``setup``, ``condition``, ``estimator``, ``versions``, ``date`` as above.
- ``episode_seed``, ``episodes``: the first episode of the job, and how many it has.
- ``job``: a hash of all that was asked for.
- ``error``: what went wrong, in one line; of failures alone.
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
JOB = ("env_id", "setup", "condition", "estimator", "episode_seed", "episodes", "job")
"""The fields that a failure has."""
TOLERANCE = 1e-6
"""By how much, relatively, scores of the same episode may differ from machine to machine."""

_BEGINNING = b'{"schema": '
"""What every line begins with."""


def game_of(row: Row) -> GameName:
    """What a row, of a scored episode or of a job that failed, was played on."""
    return GameName(row["env_id"], row["setup"], row["condition"])


class Stored(NamedTuple):
    """What a rows file holds."""

    rows: list[Row]
    """The scored episodes, in the order of the file."""
    failures: list[Row]
    """The jobs that failed and have not gone well since."""
    warning: str = ""
    """What to know about the file, if anything."""


class CannotWrite(ValueError):
    """Rows could not be written; what the file held is untouched."""


key: Callable[[Row], tuple[Any, ...]] = itemgetter(*KEY)
"""What names a row."""


def append(path: Path, rows: Iterable[Row], *, new: bool = False) -> None:
    """Append rows to a file, all or none of them, under a lock: processes and machines may share
    it. A half line at its end, of a process that was killed, is cut off first.

    Args:
        path: the file; it is made if it is not there.
        rows: what is appended.
        new: leave out scored episodes that are in the file by now, which is read for that: of two
            runs whose scores need not be the same, the first counts.

    Raises:
        CannotWrite: in one line, if the file cannot be written; what it held is untouched.
    """
    try:
        with locked(path) as file:
            present = _keys(file) if new else set()
            rows = [row for row in rows if row["kind"] != "score" or key(row) not in present]
            _write(file, b"".join(_line(row) for row in rows))
    except OSError as error:
        raise CannotWrite(f"cannot write rows to {path}: {error}") from None


def _keys(file: FileIO) -> set[tuple[Any, ...]]:
    """What names the scored episodes of an open file."""
    file.seek(0)
    rows = [_parsed(line) for line in file.readall().splitlines()]
    return {key(row) for row in rows if row is not None and row.get("kind") == "score"}


def _write(file: FileIO, data: bytes) -> None:
    """Append to a locked file, all or nothing, in place of a half line at its end."""
    begin, tail = _last_line(file)
    if _is_cut(tail):
        file.truncate(begin)
    elif tail:  # only the line's end is missing, or the line is not ours to delete
        data = b"\n" + data
    write_whole(file, data)


def _last_line(file: FileIO) -> tuple[int, bytes]:
    """Where the last line begins and what it holds, if it does not end; else the file's end."""
    begin, tail = file.seek(0, os.SEEK_END), b""
    while begin > 0:
        step = min(begin, 1 << 16 if tail else 1)  # most files end as they should
        file.seek(begin - step)
        block = file.read(step)
        _, newline, rest = block.rpartition(b"\n")
        tail = rest + tail
        if newline:
            return begin - len(rest), tail
        begin -= step
    return 0, tail


def read(path: Path) -> list[Row]:
    """The scored episodes of a file; see `load`."""
    return load(path).rows


def load(path: Path) -> Stored:
    """What a file holds; nothing if there is no such file.

    Files may be joined by concatenation: an episode that is there twice counts once. A half line at
    the end is what a killed process leaves; it is left out, with a warning.

    Raises:
        ValueError: in one line that names the file and the line, if one is not a whole row of this
            schema, or contradicts an earlier one.
    """
    if not path.exists():
        return Stored([], [])
    try:
        *lines, tail = path.read_bytes().split(b"\n")
    except OSError as error:
        raise ValueError(f"cannot read rows from {path}: {error}") from None
    warning = ""
    if not _is_cut(tail):
        lines += [tail] if tail else []
    else:
        warning = (
            f"{path}, line {len(lines) + 1}, is cut off, as a killed process leaves it; it is left "
            f"out, and what it held is run anew"
        )
    with _uncollected():
        rows, failed = _merged(path, lines)
    return Stored(rows, failed, warning)


def _merged(path: Path, lines: list[bytes]) -> tuple[list[Row], list[Row]]:
    """The scored episodes of lines, each once, and the jobs that failed."""
    rows: dict[tuple[Any, ...], Row] = {}
    numbers: dict[tuple[Any, ...], int] = {}
    failures: dict[str, Row] = {}
    parsed = _parsed_together(lines)
    for number, line in enumerate(lines, 1):
        row = _checked(path, number, line, _parsed(line) if parsed is None else parsed[number - 1])
        if row["kind"] != "score":
            known = failures.get(row["job"])
            if known is None or known["date"] <= row["date"]:  # joined files are in any order
                failures[row["job"]] = row
            continue
        name = key(row)
        if name not in rows:
            rows[name], numbers[name] = row, number
        elif not _same(rows[name], row):
            raise ValueError(
                f"{path}, lines {numbers[name]} and {number}, give different scores of the same "
                f"episode: {dict(zip(KEY, name, strict=True))}; delete one of them"
            )
    failed = [row for row in failures.values() if row["kind"] == "failure"]
    return list(rows.values()), failed


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without the search for garbage, which takes as long as reading: nothing is garbage here."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def _parsed_together(lines: list[bytes]) -> list[Any] | None:
    """What the lines hold, faster than one by one; None if one of them is damaged."""
    try:
        parsed = json.loads(b"[" + b",".join(lines) + b"]")
    except ValueError:
        return None
    whole = len(parsed) == len(lines) and all(type(row) is dict for row in parsed)
    return parsed if whole else None


def load_all(paths: Iterable[Path]) -> Stored:
    """What several files hold together, an episode that is in two of them once; as `load`.

    Raises:
        ValueError: in one line, as `load`, and if there is no such file, or two give different
            scores of an episode.
    """
    rows: dict[tuple[Any, ...], tuple[Path, Row]] = {}
    failures: dict[str, Row] = {}
    warnings = []
    for path in paths:
        if not path.exists():
            raise ValueError(f"there is no rows file {path}")
        stored = load(path)
        failures |= {row["job"]: row for row in stored.failures}
        warnings += [stored.warning] if stored.warning else []
        for row in stored.rows:
            first, earlier = rows.setdefault(key(row), (path, row))
            if first != path and not _same(earlier, row):
                raise ValueError(
                    f"{first} and {path} give different scores of the same episode: "
                    f"{dict(zip(KEY, key(row), strict=True))}; leave one of them out"
                )
    return Stored([row for _, row in rows.values()], list(failures.values()), "; ".join(warnings))


def _same(row: Row, other: Row) -> bool:
    """Whether two rows of an episode agree, but for rounding; an episode that diverged magnifies
    that without bound."""
    if row["diverged"] or other["diverged"]:
        return row["diverged"] == other["diverged"]
    return all(
        math.isclose(row[name], other[name], rel_tol=TOLERANCE, abs_tol=1e-12) for name in SCORES
    )


def _line(row: Row) -> bytes:
    first = {"schema": row["schema"]}  # the key by which a half line is known
    absent = {name for name in OPTIONAL_SCORES if row.get(name) is None}
    return json_line({n: v for n, v in (first | row).items() if n not in absent})


def _is_cut(tail: bytes) -> bool:
    """Whether what follows the last line is the beginning of a row, but not all of it."""
    begins = tail.startswith(_BEGINNING) or (tail and _BEGINNING.startswith(tail))
    return bool(begins) and _parsed(tail) is None


def _parsed(line: bytes) -> Row | None:
    """The object that a line holds, if it holds one."""
    try:
        row = json.loads(line)
    except ValueError:  # not JSON, or not text
        return None
    return row if isinstance(row, dict) else None


_ABSENT = object()
_NEEDED = {
    "score": frozenset((*KEY, *SCORES, "diverged", "ranked", "nx")),
    "failure": frozenset((*JOB, "error", "date")),
    "recovery": frozenset((*JOB, "date")),
}
"""What a row of each kind must have."""


def _checked(path: Path, number: int, line: bytes, row: Row | None) -> Row:
    """A row of this schema, with infinity where it is meant."""
    if row is None:
        shown = line[:40].decode(errors="replace")
        raise ValueError(
            f"{path}, line {number}, is cut off or is not a row: {shown!r}...; delete that line "
            f"and run again, and only what it held is run anew"
        )
    if row.get("schema") != SCHEMA:
        raise ValueError(
            f"{path}, line {number}: rows of schema {row.get('schema')!r}; expected {SCHEMA}: move "
            f"the file away and run again"
        )
    kind = row.get("kind")
    if kind not in _NEEDED:
        raise ValueError(
            f"{path}, line {number}: a row of kind {kind!r}; expected {', '.join(_NEEDED)}"
        )
    if not _NEEDED[kind] <= row.keys():
        missing = ", ".join(sorted(_NEEDED[kind] - row.keys()))
        raise ValueError(f"{path}, line {number}: a row without {missing}")
    if kind == "score":
        for name in SCORES:
            if row[name] is None:
                row[name] = math.inf
        for name in OPTIONAL_SCORES:
            if row.setdefault(name, _ABSENT) is None:
                row[name] = math.inf
            elif row[name] is _ABSENT:
                row[name] = None
    return row
