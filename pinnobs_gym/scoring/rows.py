"""Stored scores: one JSON object per line and episode, appended atomically, read and resumed."""

from __future__ import annotations

import gc
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import FileIO
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.files import CannotWrite, check_ends, json_line, locked, replacing, write_whole
from pinnobs_gym.scoring.failures import Failures
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.present import Present, present_in
from pinnobs_gym.scoring.row_format import KEY, LOG_FILES, OPTIONAL, SCHEMA, Row, checked

TOLERANCE = 1e-6
"""Largest relative difference between numbers of the same episode from different machines."""
_ASIDE = ("us_per_step", "batch", "versions", "date", "made_by", *LOG_FILES)
"""The fields in which two rows of an episode may differ."""
_ESTIMATES = frozenset((*SCORES, *OPTIONAL_SCORES, "state_rmse"))
"""The fields with numbers that depend on the estimates."""
_BEGINNING = b'{"schema": '
"""The beginning of every line."""


def game_of(row: Row) -> GameName:
    """Return the game of a row, of a scored episode or of a failed job."""
    return GameName(row["env_id"], row["setup"], row["condition"])


def episode_of(seed: int) -> str:
    """Return the name in rows of the episode of a seed."""
    return f"seed:{seed}"


def seed_of(row: Row) -> int:
    """Return the seed of a row's episode."""
    return int(row["episode"].removeprefix("seed:"))


class Stored(NamedTuple):
    """The content of a rows file."""

    rows: list[Row]
    """The scored episodes, in the order of the file."""
    failures: list[Row]
    """The jobs that failed and have not succeeded since."""
    warning: str = ""
    """A warning about the file, or an empty string."""
    uses: list[Row] = []
    """The rows of kind ``use``, in the order of the file."""
    recovered: Mapping[str, str] = {}
    """When each job that had failed succeeded last, by ``job``."""


key: Callable[[Row], tuple[Any, ...]] = itemgetter(*KEY)
"""Return the values of `KEY` of a row."""


def append(path: Path, rows: Iterable[Row], *, replace: bool = False) -> None:
    """Append rows to a file, all or none of them, under a lock: several processes and machines may
    share the file. An incomplete line at its end, left by a killed process, is cut off first.

    Scored episodes that are already in the file are left out, whoever wrote them: of two runs whose
    scores differ, the first counts. The first call reads the file, and later ones what was appended
    in between.

    Args:
        path: the file; created if it does not exist.
        rows: the rows to append.
        replace: delete earlier rows of the same episodes, together with the appending: the file is
            written anew.

    Raises:
        CannotWrite: in one line, if the file cannot be written; its content is unchanged.
    """
    try:
        with locked(path) as file:
            rows = list(rows)
            if replace:
                _replace(path, file, rows)
                return
            present = present_in(path, file, _key_in)
            _write(file, b"".join(_line(row) for row in _new(rows, present)))
    except OSError as error:
        reason = error.strerror or error
        raise CannotWrite(f"cannot write rows to {path}: {reason}; it is unchanged") from None


def _new(rows: Iterable[Row], present: Present) -> Iterator[Row]:
    """Yield the rows without the scored episodes that are present or occur before."""
    seen = set()
    for row in rows:
        if row["kind"] == "score":
            name = key(row)
            if name in present or name in seen:
                continue
            seen.add(name)
        yield row


def _replace(path: Path, file: FileIO, rows: Sequence[Row]) -> None:
    """Write a locked file anew: without the earlier rows of these episodes, and with these."""
    keys = {key(row) for row in rows if row["kind"] == "score"}
    file.seek(0)
    *lines, tail = file.readall().split(b"\n")
    lines += [] if _is_cut(tail) or not tail else [tail]
    file.close()  # Windows replaces no open file
    kept = [line + b"\n" for line in lines if _key_in(line) not in keys]
    with replacing(path, durable=True) as temporary:
        temporary.write_bytes(b"".join(kept) + b"".join(_line(row) for row in rows))


def _key_in(line: bytes) -> tuple[Any, ...] | None:
    """Return the key of the scored row in a line; None if it is another line."""
    row = _parsed(line)
    if row is None or (row.get("schema"), row.get("kind")) != (SCHEMA, "score"):
        return None
    try:
        hash(key(row))
    except (KeyError, TypeError):  # a field is missing, or is a list or an object
        return None
    return key(row)


def _write(file: FileIO, data: bytes) -> None:
    """Append to a locked file, all or nothing, replacing an incomplete line at its end."""
    begin, tail = _last_line(file)
    if _is_cut(tail):
        file.truncate(begin)
    elif tail:  # the last line lacks its newline, or is not a row
        data = b"\n" + data
    write_whole(file, data)


def _last_line(file: FileIO) -> tuple[int, bytes]:
    """Return the start and the content of the last line if it lacks a newline; else the end of the
    file and no content."""
    begin, tail = file.seek(0, os.SEEK_END), b""
    while begin > 0:
        step = min(begin, 1 << 16 if tail else 1)  # most files end in a newline
        file.seek(begin - step)
        block = file.read(step)
        _, newline, rest = block.rpartition(b"\n")
        tail = rest + tail
        if newline:
            return begin - len(rest), tail
        begin -= step
    return 0, tail


def read(path: Path) -> list[Row]:
    """Return the scored episodes of a file; see `load`."""
    return load(path).rows


def load(path: Path) -> Stored:
    """Load the content of a file; empty if it does not exist.

    Files may be concatenated: an episode that appears twice counts once. An incomplete line at the
    end, left by a killed process, is ignored with a warning.

    Raises:
        ValueError: in one line that names the file and the line, if a line is not a complete row of
            this schema, or contradicts an earlier one.
    """
    if not path.exists():
        return Stored([], [])
    try:
        check_ends(path)
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
    with _garbage_collection_paused():
        return _merged(path, lines)._replace(warning=warning)


def _merged(path: Path, lines: list[bytes]) -> Stored:
    """Return the content of the lines: each scored episode once, and the jobs that failed."""
    rows: dict[tuple[Any, ...], Row] = {}
    numbers: dict[tuple[Any, ...], int] = {}
    failures = Failures()
    uses: list[Row] = []
    # Blank lines, as an editor or a concatenation leaves them, do not count.
    kept = [(n, line) for n, line in enumerate(lines, 1) if line and not line.isspace()]
    parsed = _parsed_together([line for _, line in kept])
    for i, (number, line) in enumerate(kept):
        row = checked(path, number, line, _parsed(line) if parsed is None else parsed[i])
        if row["kind"] == "use":
            uses.append(row)
        elif row["kind"] != "score":
            failures.add(row)
        elif (name := key(row)) not in rows:
            rows[name], numbers[name] = row, number
        elif differing := _differing(rows[name], row):
            raise ValueError(
                f"{path}, lines {numbers[name]} and {number}, give different scores of the same "
                f"episode: {dict(zip(KEY, name, strict=True))} differs in {differing}; delete one "
                "of them"
            )
    return Stored(list(rows.values()), failures.left(), uses=uses, recovered=failures.recovered)


@contextmanager
def _garbage_collection_paused() -> Iterator[None]:
    """Disable the garbage collector: it takes as long as reading, and nothing here is garbage."""
    on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if on:
            gc.enable()


def _parsed_together(lines: list[bytes]) -> list[Any] | None:
    """Parse all lines at once, which is faster than one by one; None if a line is damaged."""
    try:
        parsed = json.loads(b"[" + b",".join(lines) + b"]")
    except (ValueError, RecursionError):
        return None
    whole = len(parsed) == len(lines) and all(type(row) is dict for row in parsed)
    return parsed if whole else None


def load_all(paths: Iterable[Path]) -> Stored:
    """Load several files as one; see `merge`.

    Raises:
        ValueError: in one line, as `load` does; also if a file does not exist, or two files give
            different scores of an episode.
    """
    return merge((path, _load_existing(path)) for path in paths)


def _load_existing(path: Path) -> Stored:
    if not path.exists():
        raise ValueError(f"there is no rows file {path}")
    return load(path)


def merge(sources: Iterable[tuple[Path, Stored]]) -> Stored:
    """Merge the contents of several sources, each with its path or its name for messages; an
    episode in two of them counts once.

    Raises:
        ValueError: in one line, if two sources give different scores of an episode.
    """
    rows: dict[tuple[Any, ...], tuple[Path, Row]] = {}
    failures = Failures()
    warnings: list[str] = []
    uses: list[Row] = []
    for path, stored in sources:
        failures.merge(stored.failures, stored.recovered)
        warnings += [stored.warning] if stored.warning else []
        uses += stored.uses
        for row in stored.rows:
            first, earlier = rows.setdefault(key(row), (path, row))
            if first != path and (differing := _differing(earlier, row)):
                raise ValueError(
                    f"{first} and {path} give different scores of the same episode: "
                    f"{dict(zip(KEY, key(row), strict=True))} differs in {differing}; leave one of "
                    "them out"
                )
    scored, failed = [row for _, row in rows.values()], failures.left()
    return Stored(scored, failed, "; ".join(warnings), uses, failures.recovered)


def _differing(row: Row, other: Row) -> str:
    """Return the first field in which two rows of an episode differ by more than rounding; an empty
    string if they are the same. What depends on the machine and the time of the run is not
    compared. Diverged episodes amplify rounding without bound, so the numbers that depend on their
    estimates are not compared."""
    if row == other:
        return ""
    for name in [n for n in (row | other) if n not in _ASIDE]:
        one, two = row.get(name), other.get(name)
        if name == "training":
            one, two = ({**each["training"], "seconds": None} for each in (row, other))
        rounding = math.inf if row["diverged"] and name in _ESTIMATES else TOLERANCE
        if not _alike(one, two, rounding):
            return name
    return ""


_NUMBER: tuple[Any, ...] = (int, float)  # bool is another type


def _alike(value: Any, other: Any, rounding: float) -> bool:
    """Return whether two values are equal, their numbers up to a relative rounding."""
    if type(value) in _NUMBER and type(other) in _NUMBER:
        return rounding == math.inf or math.isclose(value, other, rel_tol=rounding, abs_tol=1e-12)
    if type(value) is dict and type(other) is dict:
        return value.keys() == other.keys() and all(
            _alike(part, other[name], rounding) for name, part in value.items()
        )
    if type(value) is list and type(other) is list:
        return len(value) == len(other) and all(
            _alike(*pair, rounding) for pair in zip(value, other, strict=True)
        )
    return type(value) is type(other) and value == other


def _line(row: Row) -> bytes:
    first = {"schema": row["schema"]}  # the first key identifies an incomplete line
    return json_line(without_absent(first | row))


def without_absent(row: Row) -> Row:
    """Return a row as it is stored: without the optional numbers that do not apply."""
    return {n: v for n, v in row.items() if not (v is None and n in OPTIONAL)}


def _is_cut(tail: bytes) -> bool:
    """Return whether the text after the last newline is the beginning of a row, but not all of
    it."""
    begins = tail.startswith(_BEGINNING) or (tail and _BEGINNING.startswith(tail))
    return bool(begins) and _parsed(tail) is None


def _parsed(line: bytes) -> Row | None:
    """Return the object in a line, or None if the line is not a JSON object."""
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):  # not JSON, or not text, or nested without end
        return None
    return row if isinstance(row, dict) else None
