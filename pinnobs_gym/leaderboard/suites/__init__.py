"""Suites: the games and estimators of a leaderboard, each a TOML file.

A suite of the package is known by its name; any other is given by the path of its file. Each key is
a field of `Suite`, and every key is optional. An estimator is a name, ``module:Class``, or a table
of ``name``, ``label`` (its name in tables) and ``settings``, or ``tuned = true`` for the settings
that are stored with each system (`pinnobs_gym.scoring.tuned`). The name in tables stands for the
latter, too, as in ``"ekf, tuned"``::

    systems = ["ReverseDuffing", "Academic"]
    estimators = [
        "ekf",
        { name = "ekf", tuned = true, label = "best ekf" },
        { name = "ekf", label = "gated ekf", settings = { gate = 0.9999 } },
    ]
    conditions = ["nominal", "noise5+dropout10"]
    episodes = 20
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from pinnobs_gym.files import check_ends
from pinnobs_gym.scoring.row_format import LAST_SEED, MOST_EPISODES
from pinnobs_gym.scoring.tuned import SUFFIX
from pinnobs_gym.simulation.values import shortly
from pinnobs_gym.training.settings import SEEDS

FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class Entry:
    """An estimator of a suite."""

    name: str
    """Name or ``module:Class``."""
    label: str | None = None
    """Its name in tables; if None, the estimator's own, with its recipe where its trainer has
    several."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Its settings or, if it is trained, its trainer's."""
    tuned: bool = False
    """Whether it has the tuned settings that are stored with a system; it does not play systems
    without any."""


@dataclass(frozen=True)
class Suite:
    """The combinations of systems, estimators and conditions to play."""

    systems: tuple[str, ...] = ()
    """Names or ``module:Class``; all known systems if empty."""
    estimators: tuple[Entry, ...] = ()
    """If empty, all estimators that can be ranked, in all their `BaseEstimator.variants`, and also
    tuned where settings are stored with the system."""
    conditions: tuple[str, ...] = ()
    """If empty, nominal and the system's ranked condition. With "all", estimators that need no
    training also play every other condition that applies to the system."""
    setup: str = "benchmark"
    """Setup to play."""
    episodes: int = 100
    """Episodes of each estimator and system."""
    trained_episodes: int = 5
    """Episodes of estimators that train on every record."""
    seed: int = 0
    """Seed of the first episode."""
    training_seeds: tuple[int, ...] = ()
    """Seeds of each training; the trainer's default if empty."""
    budgets: tuple[float, ...] = (45.0,)
    """CPU seconds of each training; each budget is a separate training."""
    timeout: float | None = None
    """Longest time in s of wall-clock time that a job may take; if None, two hours and four times
    the budget."""
    file: str = field(default="", kw_only=True)
    """The file it was read from."""
    given: frozenset[str] = field(default=frozenset(), kw_only=True)
    """The keys present in the file."""

    def wrong(self, key: str, what: object) -> ValueError:
        """Return an error about the value of a key, naming the file and the key if the key is in
        the file."""
        return ValueError(f"{self.file}: {key}: {what}" if key in self.given else str(what))

    def changed(self, **changes: Any) -> Suite:
        """Return the suite with other values, checked; values that are None or empty change
        nothing.

        Raises:
            ValueError: in one line, naming the value and what was expected.
        """
        values = {name: value for name, value in changes.items() if value not in (None, ())}
        for name, value in values.items():
            values[name] = _checked(name, list(value) if isinstance(value, tuple) else value)
        return replace(self, **values, given=self.given - values.keys())


def names() -> list[str]:
    """Return the names of the suites in this folder."""
    return sorted(path.stem for path in FOLDER.glob("*.toml"))


def load(spec: str) -> Suite:
    """Load a suite by its name or its file's path.

    Raises:
        ValueError: in one line, naming the file, the key, its value and what was expected.
    """
    path = FOLDER / f"{spec}.toml" if spec in names() else Path(spec)
    if path.suffix != ".toml":
        raise ValueError(
            f"unknown suite {spec!r}; known are {', '.join(names())}, and files that end in .toml"
        )
    file = f"suite {spec}"
    try:
        check_ends(path)
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"cannot read {file}: {error.strerror or error}") from None
    except ValueError as error:  # not TOML, or not text
        raise ValueError(f"{file} is no TOML: {error}") from None
    except RecursionError:
        raise ValueError(f"{file} is nested too deeply") from None
    known = [f.name for f in fields(Suite) if not f.kw_only]
    values = {}
    for key, value in content.items():
        if key not in known:
            raise ValueError(f"{file}: unknown key {key!r}; expected one of {', '.join(known)}")
        try:
            values[key] = _checked(key, value)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    return Suite(**values, file=file, given=frozenset(values))


def expected(key: str) -> str:
    """Return in words what the value of a key has to be."""
    words, _ = _EXPECTED[key]
    return f"a list of {words}" if key in _SEVERAL else words


def _checked(key: str, value: Any) -> Any:
    """Check a value and return it in the form that the suite stores."""
    _, fits = _EXPECTED[key]
    several = key in _SEVERAL
    if several and not isinstance(value, list):
        raise ValueError(f"{key}={shortly(value)}; expected {expected(key)}")
    for part in value if several else [value]:
        if not fits(part):
            raise ValueError(f"{key}={shortly(value)}; expected {expected(key)}")
    if key == "estimators":
        return tuple(_entry(part) for part in value)
    if several and len({repr(part) for part in value}) < len(value):
        raise ValueError(f"{key}={shortly(value)}; expected each but once")
    return tuple(value) if several else value


def _entry(value: Any) -> Entry:
    if isinstance(value, Entry):
        return value
    if not isinstance(value, Mapping):
        return Entry(value.removesuffix(SUFFIX), tuned=value.endswith(SUFFIX))
    known = [f.name for f in fields(Entry)]
    for key in value:
        if key not in known:
            raise ValueError(
                f"estimators: unknown key {key!r} in {dict(value)!r}; expected one of "
                f"{', '.join(known)}"
            )
    entry = Entry(**{"name": "", **value})
    if not (isinstance(entry.name, str) and entry.name):
        raise ValueError(f"estimators: {dict(value)!r} has no name")
    label = entry.label
    if label is not None and not (
        isinstance(label, str) and re.fullmatch(r"\w[\w .,=+%-]*", label)
    ):
        raise ValueError(
            f"estimators: label={shortly(label)}; expected letters, digits, spaces and "
            "_ . , = + % -"
        )
    if not isinstance(entry.settings, Mapping):
        raise ValueError(f"estimators: settings={entry.settings!r}; expected a table")
    if not isinstance(entry.tuned, bool):
        raise ValueError(f"estimators: tuned={entry.tuned!r}; expected true or false")
    if entry.tuned and entry.settings:
        raise ValueError(f"estimators: {dict(value)!r} is tuned and has settings; expected one")
    return entry


def _whole(least: int, most: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and least <= value <= most


def _name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


_EPISODES = f"at least 1, at most {MOST_EPISODES}", _whole(1, MOST_EPISODES)
_SEVERAL = ("systems", "estimators", "conditions", "training_seeds", "budgets")
_EXPECTED: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "systems": ("names", _name),
    "estimators": (
        "names and tables",
        lambda v: _name(v) or isinstance(v, Mapping | Entry),
    ),
    "conditions": ("names", _name),
    "setup": ("a name", _name),
    "episodes": _EPISODES,
    "trained_episodes": _EPISODES,
    "seed": (
        f"at least 0, at most {LAST_SEED - MOST_EPISODES}",
        _whole(0, LAST_SEED - MOST_EPISODES),
    ),
    "training_seeds": (
        f"whole numbers from 0 to {SEEDS - 1}",
        lambda v: type(v) is int and 0 <= v < SEEDS,
    ),
    "budgets": (
        "positive numbers of seconds",
        lambda v: type(v) in (int, float) and 0 < v < float("inf"),
    ),
    "timeout": (
        "a positive number of seconds",
        lambda v: type(v) in (int, float) and 0 < v < float("inf"),
    ),
}
"""The expected value of each key, in words and as a check of one item."""
