"""The format of stored rows, and the check of what a file holds."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterator, Mapping
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from pinnobs_gym.scoring.metrics import DIVERGED, OPTIONAL_SCORES, SCORES

SCHEMA = 5
"""Version of the row format."""

Row: TypeAlias = dict[str, Any]
"""One scored episode (``kind`` is ``score``). Its keys:

- ``schema``: version of this format.
- ``env_id``, ``setup``, ``condition``, ``episode``: the episode; ``seed:12`` is that of seed 12. A
  sensor log with reference states has the setup ``log``, and as seed a hash of its samples and its
  reference (`pinnobs_gym.scoring.log_game.episode_number`).
- ``log``, ``reference``: of a sensor log, the names of its files; absent otherwise.
- ``game_hash``: hash of the code and settings that make and score the episode.
- ``ranked``: whether the system is ranked under this condition; ``nx``: number of states; of a
  log, of those that are scored.
- ``free_over_known``, ``nominal_over_free``: how what the condition changes without estimators
  being told enlarges steady errors (`pinnobs_gym.scoring.identifiability.Identifiability`); absent
  where there is nothing of this kind.
- ``estimator``, ``track``, ``knows``, ``options``: the estimator, its track, its prior knowledge
  and its options. One that was trained under the condition that is scored has a track of its own,
  and so have estimates that were submitted (`pinnobs_gym.scoring.submitted`); ``knows`` of these
  begins with ``submitted``, and their ``options`` have the hash of the estimates.
- ``settings``: what is not as usual (`pinnobs_gym.scoring.deviations`); names in tables have it.
- ``made_by``: what a command or a suite takes to play it, where the names do not say it; absent
  otherwise. ``estimator``: name or ``module:Class``; ``settings``: those that a label stands for;
  ``system``: ``module:Class``.
- ``estimator_code``: hash of the estimator's code.
- ``estimator_hash``: hash of its code, settings, model and training.
- ``training``, ``training_seed``: for trained estimators, how they were trained: seconds, config,
  ...
- the scores of `pinnobs_gym.scoring.metrics.score` by name; ``null`` stands for infinity.
- ``state_rmse``: RMSE of each state in its unit, by window (``transient``, ``steady``) and name.
- the scores of `pinnobs_gym.scoring.metrics.OPTIONAL_SCORES` that apply, in the same format; the
  others are None here and absent from the file.
- ``effective_sample_size``, ``monte_carlo``: of a floor, how precise it is: the smallest effective
  sample size of the weighted draws at any sample of the episode, of exact Bayes; the Monte-Carlo
  standard error of its means, relative to its standard deviations, of a particle reference. Absent
  otherwise. Floors have the tracks ``floor`` (filtered) and ``floor, whole`` (smoothed).
- ``us_per_step``: CPU microseconds per step and episode, in the batch it was run in; without what
  an online estimator prepares once. Not known, and absent, of submitted estimates.
- ``batch``: the size of that batch.
- ``versions``, ``date``: versions of the packages, and time of the run (UTC).

Other rows are a job of a leaderboard that failed (``kind`` is ``failure``), or one that failed
before and then succeeded (``recovery``). Their keys:

- ``schema``, ``env_id``, ``setup``, ``condition``, ``estimator``, ``versions``, ``date``: as above.
- ``episode``, ``episodes``: the first episode of the job, and the number of episodes.
- ``job``: a hash of the job's full specification.
- ``error``: the error in one line; for failures only.

Rows of kind ``use`` say that episodes of this game and estimator were taken from the file: their
code is the present one at that date. Their keys: ``schema``, ``env_id``, ``setup``, ``condition``,
``game_hash``, ``estimator``, ``estimator_hash``, ``date``, as above.
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
OPTIONAL = (
    *OPTIONAL_SCORES,
    *(
        "free_over_known",
        "nominal_over_free",
        "effective_sample_size",
        "monte_carlo",
        "us_per_step",
    ),
)
"""The numbers that may be absent."""
FLOOR = "floor"
"""Track of the floor of errors that is filtered, for online estimators."""
FLOOR_WHOLE = "floor, whole"
"""Track of the floor of errors that is smoothed, for offline estimators."""
SUBMITTED = "submitted"
"""What ``knows`` of submitted estimates begins with."""
LOG_FILES = ("log", "reference")
"""The fields that rows of logs have in addition."""
NAMES = ("env_id", "setup", "condition", "estimator", "track")
"""The fields that are names."""
NEEDED = {
    "score": frozenset(
        (
            *(*KEY, *SCORES, "diverged", "ranked", "nx", "estimator_code", "track", "knows"),
            *("options", "settings", "training", "versions", "date", "state_rmse"),
        )
    ),
    "failure": frozenset((*JOB, "error", "date")),
    "recovery": frozenset((*JOB, "date")),
    "use": frozenset(
        ("env_id", "setup", "condition", "game_hash", "estimator", "estimator_hash", "date")
    ),
}
"""The required fields of each kind of row, beside ``schema`` and ``kind``."""

LAST_SEED = 2**63 - 1
"""Largest seed of an episode, and largest count."""
MOST_EPISODES = 10**7
"""Largest number of episodes of an evaluation."""
_HUGE = re.compile(rb"[0-9][eE]\+?[0-9]{3}")
"""The end of a number that may be beyond those of double precision."""
_LONGEST_SHOWN = 60
"""Largest number of characters that an error shows of a value."""
_MOST_STATES = 10**6
"""Largest number of states of a system."""
_DATE = re.compile(
    r"[0-9]{4}-[0-9]{2}-[0-9]{2}"
    r"(T[0-9]{2}:[0-9]{2}:[0-9]{2}(\.[0-9]{3}([0-9]{3})?)?(\+00:00|Z)?)?"
)
"""A date, or a date and time (UTC) as `pinnobs_gym.scoring.provenance.now` writes it."""


def _is_text(value: object) -> bool:
    return type(value) is str and len(value) <= 1000


def is_name(value: object) -> bool:
    """Return whether a value is a name, as `NAME_EXPECTED` says."""
    return type(value) is str and 0 < len(value) <= 1000 and value == value.strip()


def _is_date(value: object) -> bool:
    return type(value) is str and len(value) <= 32 and _is_time(value)


@lru_cache(maxsize=4096)
def _is_time(value: str) -> bool:
    """Return whether a text is a date that exists; many rows have the same one."""
    if _DATE.fullmatch(value) is None:
        return False
    try:
        datetime.fromisoformat(value)
    except ValueError:
        return False
    return True


def _is_count(value: object) -> bool:
    return type(value) is int and 0 <= value <= LAST_SEED


def _is_dimension(value: object) -> bool:
    return type(value) is int and 1 <= value <= _MOST_STATES


def _is_seed(value: object) -> bool:
    return value is None or _is_count(value)


def _is_flag(value: object) -> bool:
    return type(value) is bool


def _is_object(value: object) -> bool:
    return type(value) is dict


def _is_episode(value: object) -> bool:
    if type(value) is not str or re.fullmatch(r"seed:(0|[1-9][0-9]{0,18})", value) is None:
        return False
    return len(value) < len("seed:") + 19 or int(value[5:]) <= LAST_SEED


def _are_texts(value: object) -> bool:
    return type(value) is list and all(map(_is_text, value))


def _is_positive(value: object) -> bool:
    return type(value) in (int, float) and 0 < value <= sys.float_info.max  # pyright: ignore


def _is_cost(value: object) -> bool:
    return type(value) in (int, float) and 0 <= value <= sys.float_info.max  # pyright: ignore


_TEXT = ("a text of at most 1000 characters", _is_text)
NAME_EXPECTED = "a text of 1 to 1000 characters, without white space at its ends"
"""What a name is, for messages."""
_NAME = (NAME_EXPECTED, is_name)
_COUNT = ("a whole number of at least 0", _is_count)
_COST = ("a number of at least 0", _is_cost)
_FLAG = ("true or false", _is_flag)
_OBJECT = ("an object", _is_object)
_KINDS = {
    **dict.fromkeys(NAMES, _NAME),
    **dict.fromkeys(("game_hash", "estimator_code", "estimator_hash", "job", "error"), _TEXT),
    "date": ("a date or time (UTC) such as 2030-01-02 or 2030-01-02T03:04:05.678+00:00", _is_date),
    "episodes": _COUNT,
    "nx": (f"a whole number from 1 to {_MOST_STATES}", _is_dimension),
    "episode": ("seed: and a whole number of at least 0, such as seed:12", _is_episode),
    **dict.fromkeys(("diverged", "ranked"), _FLAG),
    **dict.fromkeys(("options", "settings", "training", "versions"), _OBJECT),
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
_TRAINING = {"config": _OBJECT, "seconds": _COST, "iterations": _COST}
"""The fields of a training that are read, each of which may be absent."""
_BUDGET = ("a positive number, or null", lambda value: value is None or _is_positive(value))


def check_names(row: Row) -> None:
    """Check the names of a row before it is written.

    Raises:
        ValueError: in one line, if one is empty, too long or has white space at its ends.
    """
    for name in NAMES:
        if not is_name(row[name]):
            raise ValueError(f"{name}={shown(row[name])}; expected {_NAME[0]}")


def checked(path: Path, number: int, line: bytes, row: Row | None) -> Row:
    """Check that a row has this schema and restore its infinities.

    Args:
        path: the file, for messages.
        number: of the line, for messages.
        line: the line; empty for a row that was stored otherwise.
        row: the object in the line; None if the line is not an object.

    Raises:
        ValueError: in one line that names the file, the line and the field.
    """
    if row is None:
        text = line[:40].decode(errors="replace")
        raise ValueError(
            f"{path}, line {number}, is cut off or is not a row: {text!r}... ({_reason(line)}); "
            "delete that line and run again, and only what it held is run anew"
        )
    try:
        if line and line.count(b'":') != _number_of_keys(row):
            json.loads(line, object_pairs_hook=_without_repeated)
        _check(row, b"NaN" in line or b"Infinity" in line or _HUGE.search(line) is not None)
    except ValueError as error:
        raise ValueError(f"{path}, line {number}: {error}") from None
    except RecursionError:
        raise ValueError(f"{path}, line {number}: a row that is nested too deeply") from None
    return row


def _reason(line: bytes) -> str:
    """Return why a line is not a JSON object."""
    try:
        return f"JSON of a {type(json.loads(line)).__name__}; expected an object"
    except RecursionError:
        return "nested too deeply"
    except UnicodeDecodeError:
        return "not in UTF-8"
    except json.JSONDecodeError as error:
        return f"{error.msg}, column {error.colno}"
    except ValueError:  # Python reads no whole number of more than some thousand digits
        return "a number of too many digits"


def _number_of_keys(value: object) -> int:
    """Return the number of keys of all objects in a value."""
    if type(value) is dict:
        return len(value) + sum(
            _number_of_keys(v) for v in value.values() if type(v) in (dict, list)
        )
    if type(value) is list:
        return sum(_number_of_keys(v) for v in value if type(v) in (dict, list))
    return 0


def _without_repeated(pairs: list[tuple[str, Any]]) -> Row:
    """Return the object of these keys and values.

    Raises:
        ValueError: in one line, if a key is repeated.
    """
    found: Row = {}
    for name, value in pairs:
        if name in found:
            raise ValueError(f"{_short(name)} is given twice; expected once")
        found[name] = value
    return found


def _check(row: Row, constants: bool) -> None:
    """Check a row, and restore its infinities.

    Args:
        row: the row.
        constants: whether it may hold NaN or infinity, which Python reads though JSON has neither.
    """
    if row.get("schema") != SCHEMA:
        raise ValueError(
            f"rows of schema {shown(row.get('schema'))}; expected {SCHEMA}: move the file away and "
            "run again"
        )
    kind = row.get("kind")
    if type(kind) is not str or kind not in NEEDED:
        raise ValueError(f"a row of kind {shown(kind)}; expected {', '.join(NEEDED)}")
    for place, value in _not_finite("", row) if constants else ():
        raise ValueError(f"{place}={shown(value)}; expected a value that JSON has")
    if not NEEDED[kind] <= row.keys():
        raise ValueError(f"a row without {', '.join(sorted(NEEDED[kind] - row.keys()))}")
    for name, expected, fits in FIELDS[kind]:
        if not fits(row[name]):
            raise ValueError(f"{name}={shown(row[name])}; expected {expected}")
    if kind == "score":
        if "us_per_step" not in row and SUBMITTED not in row["knows"]:
            raise ValueError("a row without us_per_step")
        for name in LOG_FILES:
            if name in row and not is_name(row[name]):
                raise ValueError(f"{name}={shown(row[name])}; expected {NAME_EXPECTED}")
        if not _is_object(row.get("made_by", {})):
            raise ValueError(f"made_by={shown(row['made_by'])}; expected {_OBJECT[0]}")
        if not _is_count(row.get("batch", 0)):
            raise ValueError(f"batch={shown(row['batch'])}; expected {_COUNT[0]}")
        _check_training(row["training"])
        _restore(row)


def _not_finite(place: str, value: object) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a value that are not finite, and their places, such as
    ``training.loss``."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield from _not_finite(_place(place, name) if place else _short(name), part)
    elif isinstance(value, list):
        for part in value:
            yield from _not_finite(place, part)
    elif type(value) is float and not math.isfinite(value):
        yield place, value


def _check_training(training: Mapping[str, Any]) -> None:
    """Check those values of a training that tables read."""
    for name, (expected, fits) in _TRAINING.items():
        if name in training and not fits(training[name]):
            raise ValueError(f"training.{name}={shown(training[name])}; expected {expected}")
    budget = training.get("config", {}).get("budget")
    expected, fits = _BUDGET
    if not fits(budget):
        raise ValueError(f"training.config.budget={shown(budget)}; expected {expected}")


def _restore(row: Row) -> None:
    """Check the scores of a row and restore their infinities."""
    for name in SCORES:
        value = row[name]
        if type(value) is not float or not 0 <= value <= 1:  # most are, and every score may be
            row[name] = _score(name, value)
    for name in OPTIONAL:
        row[name] = _score(name, row[name]) if name in row else None
    row["state_rmse"] = {
        window: _states(_place("state_rmse", window), states)
        for window, states in row["state_rmse"].items()
    }
    if row["diverged"] == (row["nrmse_tail"] <= DIVERGED):
        where = f"above {DIVERGED}, or null," if row["diverged"] else f"at most {DIVERGED}"
        tail = None if row["nrmse_tail"] == math.inf else row["nrmse_tail"]
        raise ValueError(
            f"nrmse_tail={shown(tail)}; expected {where} with diverged={shown(row['diverged'])}"
        )


def _states(place: str, states: object) -> dict[str, float]:
    """Return the errors of each state over a window."""
    if type(states) is not dict:
        raise ValueError(f"{place}={shown(states)}; expected an object of states")
    return {name: _score(_place(place, name), value) for name, value in states.items()}


_LEAST = {"innovation_correlation": -1}
"""The least value of a score that may be negative."""
_MOST = {"coverage": 1}
"""The largest value of a score that is never infinite."""


def _score(name: str, value: object) -> float:
    """Return a score, of which null stands for infinity."""
    most = _MOST.get(name)
    if value is None and most is None:
        return math.inf
    least, largest = _LEAST.get(name, 0), sys.float_info.max if most is None else most
    if type(value) in (float, int) and least <= value <= largest:  # pyright: ignore
        return float(value)  # pyright: ignore[reportArgumentType]
    expected = f"of at least {least}, or null for infinity" if most is None else f"from 0 to {most}"
    raise ValueError(f"{name}={shown(value)}; expected a number {expected}")


def _place(where: str, name: str) -> str:
    """Return how an error names a field of an object."""
    return f"{where}.{_short(name)}"


def _short(name: str) -> str:
    """Return a field's name on one line, shortened."""
    return name if name.isprintable() and len(name) <= _LONGEST_SHOWN else shown(name)


def shown(value: object) -> str:
    """Return the beginning of what JSON shows of a value."""
    text = json.dumps(value)
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 3] + "..."
