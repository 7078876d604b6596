"""Stored scores: one JSON object per line and episode, appended atomically, read and resumed."""

from __future__ import annotations

import gc
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from io import FileIO
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.files import json_line, locked, replacing, write_whole
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.present import Present, present_in

SCHEMA = 5
"""Version of the row format."""

Row: TypeAlias = dict[str, Any]
"""One scored episode (``kind`` is ``score``). Its keys:

- ``schema``: version of this format.
- ``env_id``, ``setup``, ``condition``, ``episode``: the episode; ``seed:12`` is that of seed 12.
- ``game_hash``: hash of the code and settings that make and score the episode.
- ``ranked``: whether the system is ranked under this condition; ``nx``: number of states.
- ``free_over_known``, ``nominal_over_free``: how what the condition changes without estimators
  being told enlarges steady errors (`pinnobs_gym.scoring.identifiability.Identifiability`); absent
  where there is nothing of this kind.
- ``estimator``, ``track``, ``knows``, ``options``: the estimator, its track, its prior knowledge
  and its settings. One that was trained under the condition that is scored has a track of its own.
- ``estimator_code``: hash of the estimator's code.
- ``estimator_hash``: hash of its code, settings, model and training.
- ``training``, ``training_seed``: for trained estimators, how they were trained: seconds, config,
  ...
- the scores of `pinnobs_gym.scoring.metrics.score` by name; ``null`` stands for infinity.
- ``state_rmse``: RMSE of each state in its unit, by window (``transient``, ``steady``) and name.
- the scores of `pinnobs_gym.scoring.metrics.OPTIONAL_SCORES` that apply, in the same format; the
  others are None here and absent from the file.
- ``us_per_step``: CPU microseconds per step and episode, in the batch it was run in.
- ``batch``: the size of that batch.
- ``versions``, ``date``: versions of the packages, and time of the run (UTC).

Other rows are a job of a leaderboard that failed (``kind`` is ``failure``), or one that failed
before and then succeeded (``recovery``). Their keys:

- ``schema``, ``env_id``, ``setup``, ``condition``, ``estimator``, ``versions``, ``date``: as above.
- ``episode``, ``episodes``: the first episode of the job, and the number of episodes.
- ``job``: a hash of the job's full specification.
- ``error``: the error in one line; for failures only.
"""

KEY = (
    "env_id",
    "setup",
    "condition",
    "game_hash",
    "estimator",
    "estimator_hash",
    "training_seed",
    "episode",
)
"""The fields that identify a scored row; they are unique in a file."""
JOB = ("env_id", "setup", "condition", "estimator", "episode", "episodes", "job")
"""The fields of a job in failures and recoveries."""
TOLERANCE = 1e-6
"""Largest relative difference between scores of the same episode from different machines."""

OPTIONAL = (*OPTIONAL_SCORES, "free_over_known", "nominal_over_free")
"""The numbers that may be absent."""
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


class CannotWrite(ValueError):
    """Rows could not be written; the content of the file is unchanged."""


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
        raise CannotWrite(f"cannot write rows to {path}: {error}") from None


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
    keys = {key(row) for row in rows}
    file.seek(0)
    *lines, tail = file.readall().split(b"\n")
    lines += [] if _is_cut(tail) or not tail else [tail]
    file.close()  # Windows replaces no open file
    kept = [line + b"\n" for line in lines if _key_in(line) not in keys]
    with replacing(path) as temporary:
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
        rows, failed = _merged(path, lines)
    return Stored(rows, failed, warning)


def _merged(path: Path, lines: list[bytes]) -> tuple[list[Row], list[Row]]:
    """Return the scored episodes of the lines, each once, and the jobs that failed."""
    rows: dict[tuple[Any, ...], Row] = {}
    numbers: dict[tuple[Any, ...], int] = {}
    failures: dict[str, Row] = {}
    parsed = _parsed_together(lines)
    for number, line in enumerate(lines, 1):
        row = _checked(path, number, line, _parsed(line) if parsed is None else parsed[number - 1])
        if row["kind"] != "score":
            known = failures.get(row["job"])
            if known is None or known["date"] <= row["date"]:  # concatenated files are in any order
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
    """Load several files as one; an episode in two of them counts once.

    Raises:
        ValueError: in one line, as `load` does; also if a file does not exist, or two files give
            different scores of an episode.
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
    """Return whether two rows of an episode agree up to rounding. Diverged episodes amplify
    rounding without bound, so their scores are not compared."""
    if row["diverged"] or other["diverged"]:
        return row["diverged"] == other["diverged"]
    return all(
        math.isclose(row[name], other[name], rel_tol=TOLERANCE, abs_tol=1e-12) for name in SCORES
    )


def _line(row: Row) -> bytes:
    first = {"schema": row["schema"]}  # the first key identifies an incomplete line
    absent = {name for name in OPTIONAL if row.get(name) is None}
    return json_line({n: v for n, v in (first | row).items() if n not in absent})


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


NEEDED = {
    "score": frozenset(
        (
            *(*KEY, *SCORES, "diverged", "ranked", "nx", "estimator_code", "track", "knows"),
            *("options", "training", "versions", "us_per_step", "date", "state_rmse"),
        )
    ),
    "failure": frozenset((*JOB, "error", "date")),
    "recovery": frozenset((*JOB, "date")),
}
"""The required fields of each kind of row."""


_LONGEST_SHOWN = 60
"""Largest number of characters that an error shows of a value."""


def _is_text(value: object) -> bool:
    return type(value) is str and len(value) <= 1000


def _is_count(value: object) -> bool:
    return type(value) is int and value >= 0


def _is_seed(value: object) -> bool:
    return value is None or _is_count(value)


def _is_flag(value: object) -> bool:
    return type(value) is bool


def _is_object(value: object) -> bool:
    return type(value) is dict


def _is_episode(value: object) -> bool:
    return type(value) is str and re.fullmatch(r"seed:(0|[1-9]\d{0,18})", value) is not None


def _are_texts(value: object) -> bool:
    return type(value) is list and all(map(_is_text, value))


_TEXT = ("a text of at most 1000 characters", _is_text)
_COUNT = ("a whole number of at least 0", _is_count)
_FLAG = ("true or false", _is_flag)
_OBJECT = ("an object", _is_object)
_KINDS = {
    **dict.fromkeys(("env_id", "setup", "condition", "estimator", "track", "date", "error"), _TEXT),
    **dict.fromkeys(("game_hash", "estimator_code", "estimator_hash", "job"), _TEXT),
    **dict.fromkeys(("episodes", "nx"), _COUNT),
    "episode": ("seed: and a whole number of at least 0, such as seed:12", _is_episode),
    **dict.fromkeys(("diverged", "ranked"), _FLAG),
    **dict.fromkeys(("options", "training", "versions"), _OBJECT),
    "training_seed": ("a whole number of at least 0, or null", _is_seed),
    "state_rmse": ("an object of windows, each an object of states", _is_object),
    "knows": ("a list of texts", _are_texts),
}
FIELDS = {
    kind: [(name, *_KINDS[name]) for name in sorted(needed) if name in _KINDS]
    for kind, needed in NEEDED.items()
}
"""The required fields of each kind of row that are no scores: what is expected, and whether a value
fits."""


def _checked(path: Path, number: int, line: bytes, row: Row | None) -> Row:
    """Check that a row has this schema and restore its infinities."""
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
    if kind not in NEEDED:
        raise ValueError(
            f"{path}, line {number}: a row of kind {kind!r}; expected {', '.join(NEEDED)}"
        )
    if not NEEDED[kind] <= row.keys():
        missing = ", ".join(sorted(NEEDED[kind] - row.keys()))
        raise ValueError(f"{path}, line {number}: a row without {missing}")
    for name, expected, fits in FIELDS[kind]:
        if not fits(row[name]):
            raise ValueError(
                f"{path}, line {number}: {name}={_shown(row[name])}; expected {expected}"
            )
    if kind == "score":
        for name in (*SCORES, "us_per_step"):
            row[name] = _score(path, number, name, row[name])
        for name in OPTIONAL:
            row[name] = _score(path, number, name, row[name]) if name in row else None
        row["state_rmse"] = {
            window: _states(path, number, window, states)
            for window, states in row["state_rmse"].items()
        }
    return row


def _states(path: Path, number: int, window: str, states: object) -> dict[str, float]:
    """Return the errors of each state over a window."""
    if type(states) is not dict:
        raise ValueError(
            f"{path}, line {number}: state_rmse.{window}={_shown(states)}; expected an object of "
            "states"
        )
    return {n: _score(path, number, f"state_rmse.{window}.{n}", v) for n, v in states.items()}


def _score(path: Path, number: int, name: str, value: object) -> float:
    """Return a score, of which null stands for infinity."""
    if value is None:
        return math.inf
    signed = name == "innovation_correlation"
    if type(value) in (float, int) and (value >= 0 or (signed and value >= -1)):  # pyright: ignore
        return float(value)  # pyright: ignore[reportArgumentType]
    least = "-1" if signed else "0"
    raise ValueError(
        f"{path}, line {number}: {name}={_shown(value)}; expected a number of at least {least}, or "
        "null for infinity"
    )


def _shown(value: object) -> str:
    """Return the beginning of what JSON shows of a value."""
    text = json.dumps(value)
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 3] + "..."
