"""How scores were made: settings, training, versions, and the command that makes them anew."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

from pinnobs_gym.leaderboard.standings import training_of
from pinnobs_gym.scoring.rows import Row

Players = Mapping[str, Mapping[str, Sequence[Row]]]
"""Rows by the estimator's name in the overview and by what is played."""


@dataclass(frozen=True)
class Method:
    """How one estimator's scores were made."""

    estimator: str
    track: str
    told: str
    settings: str
    training: str
    episodes: int
    """How many rows."""
    dates: str


def methods(players: Players) -> list[Method]:
    """How each estimator's scores were made."""
    found = []
    for name, games in players.items():
        rows = list(chain.from_iterable(games.values()))
        first = rows[0]
        found.append(
            Method(
                estimator=name,
                track=first["track"],
                told=", ".join(first["knows"]),
                settings="; ".join(
                    dict.fromkeys(_settings(row["options"]) for row in _some(games))
                ),
                training=training_of(rows),
                episodes=len(rows),
                dates=dates(rows),
            )
        )
    return found


def _some(games: Mapping[str, Sequence[Row]]) -> Iterable[Row]:
    return (rows[0] for rows in games.values())


def _settings(options: Mapping[str, Any]) -> str:
    """Settings in one line, those of None left out."""
    parts = []
    for name, value in options.items():
        if isinstance(value, Mapping):
            parts.append(f"{name}: {_settings(value)}")
        elif value is not None:
            parts.append(f"{name}={value:g}" if isinstance(value, float) else f"{name}={value}")
    return ", ".join(parts)


def dates(rows: Sequence[Row]) -> str:
    """The day, or the first and the last, on which the rows were made."""
    days = {str(row["date"])[:10] for row in rows}
    return " to ".join(sorted({min(days), max(days)}))


def versions(rows: Iterable[Row]) -> dict[str, str]:
    """The versions of each package that rows were made with."""
    found: dict[str, set[str]] = {}
    for versions in {tuple(row["versions"].items()) for row in rows}:
        for name, version in versions:
            found.setdefault(name, set()).add(version)
    return {name: ", ".join(sorted(those)) for name, those in sorted(found.items())}


def commands(rows: Sequence[Row]) -> list[str]:
    """Command lines that make these rows anew: one per setup for the conditions that are played by
    default, and one for each set of others that some systems were played under. They may make
    more rows, since every estimator named plays every system named."""
    usual: dict[str, list[Row]] = {}
    others: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row["ranked"] or row["condition"] == "nominal":
            usual.setdefault(row["setup"], []).append(row)
        else:
            others.setdefault((row["setup"], row["env_id"]), []).append(row)
    alike: dict[tuple[str, ...], list[Row]] = {}
    for (setup, _), some in others.items():
        played = dict.fromkeys(row["condition"] for row in some)
        alike.setdefault((setup, *sorted(played)), []).extend(some)
    lines = [_command(some) for some in usual.values()]
    return lines + [_command(some, conditions) for (_, *conditions), some in alike.items()]


def _command(rows: Sequence[Row], conditions: Sequence[str] = ()) -> str:
    words = ["pinnobs leaderboard"]
    systems = {row["env_id"].removeprefix("pinnobs/").rpartition("-v")[0] for row in rows}
    words += ["--systems", *sorted(systems)]
    words += ["--estimators", *sorted({row["estimator"] for row in rows})]
    setup = rows[0]["setup"]
    words += ["--setup", setup] if setup != "benchmark" else []
    words += ["--condition", *conditions] if conditions else []
    alone = {row["episode_seed"] for row in rows if row["training"].get("per_record")}
    seeds = {row["episode_seed"] for row in rows}
    words += ["--episodes", str(max(seeds) - min(seeds) + 1)]
    words += ["--trained-episodes", str(max(alone) - min(alone) + 1)] if alone else []
    budgets = {row["training"].get("config", {}).get("budget") for row in rows} - {None}
    words += ["--budget", f"{max(budgets):g}"] if budgets else []
    words += ["--seed", str(min(seeds))] if min(seeds) else []
    return " ".join(words)
