"""Stored scores told apart by the code and the settings that made them, before tables are made."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.scoring.rows import Row, game_of

_SHOWN = 6
"""Number of characters of a hash that are shown."""


class Distinct(NamedTuple):
    """Rows that may be compared under their names."""

    rows: list[Row]
    notes: tuple[str, ...]
    """What was left out, a sentence each."""


def distinct(rows: Sequence[Row]) -> Distinct:
    """Return the rows of the newest code of each game, in which estimators that differ have names
    that differ.

    Episodes of a game whose code or settings have changed are not comparable: the newest are kept,
    and a note says what is left out. Of the estimators of one name and training budget that differ
    in settings or code, the one with the most rows keeps its name, and the names of the others say
    what differs. Runs of a game that still look alike are named by their hashes.
    """
    kept, notes = _of_newest_games(rows)
    return Distinct(_named_by_hash(_named_by_difference(kept)), notes)


def name_of(row: Row) -> str:
    """Return the name of a row's estimator, with its training budget."""
    budget = row["training"].get("config", {}).get("budget")
    return row["estimator"] if budget is None else f"{row['estimator']}, {budget:g} s"


def _of_newest_games(rows: Sequence[Row]) -> tuple[list[Row], tuple[str, ...]]:
    """Return the rows of the newest hash of each game, and a note on those of each other hash."""
    newest: dict[GameName, tuple[str, str]] = {}
    for row in rows:
        game, version = game_of(row), (row["date"], row["game_hash"])
        newest[game] = max(newest.get(game, version), version)
    kept = [row for row in rows if row["game_hash"] == newest[game_of(row)][1]]
    older = Counter(
        (game_of(row), row["game_hash"])
        for row in rows
        if row["game_hash"] != newest[game_of(row)][1]
    )
    return kept, tuple(
        f"{count} episodes of {', '.join(game)} are left out: the code or the settings of the "
        f"system, the simulation or the scores have changed since (hash {old[:_SHOWN]}, now "
        f"{newest[game][1][:_SHOWN]})."
        for (game, old), count in sorted(older.items())
    )


def _named_by_difference(rows: Sequence[Row]) -> list[Row]:
    """Return rows whose estimators are renamed where several have one name."""
    groups: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        groups[name_of(row)][json.dumps(_facts(row), sort_keys=True)].append(row)
    names: dict[tuple[str, str], str] = {}
    for name, variants in groups.items():
        plain, *others = sorted(variants, key=lambda facts: _precedence(variants[facts]))
        for facts in others:
            names[name, facts] = _difference(json.loads(facts), json.loads(plain))
    renamed = []
    for row in rows:
        suffix = names.get((name_of(row), json.dumps(_facts(row), sort_keys=True)))
        changed = {} if suffix is None else {"estimator": f"{row['estimator']} ({suffix})"}
        renamed.append(row | changed)
    return renamed


def _facts(row: Row) -> dict[str, Any]:
    """Return what may differ between estimators of one name: settings and code. Trained ones may
    differ in their training seeds and still be one."""
    config = row["training"].get("config", {})
    trained = {name: value for name, value in config.items() if name not in ("seed", "budget")}
    if "condition" in row["training"]:
        trained["trained_under"] = row["training"]["condition"]
    settings = trained if row["training"] else row["options"]
    return {**settings, "code": row["estimator_code"]}


def _precedence(rows: Sequence[Row]) -> tuple[int, tuple[int, ...]]:
    """Return the sort key of variants: the most rows first, then the latest."""
    return -len(rows), tuple(-ord(character) for character in max(row["date"] for row in rows))


def _difference(facts: Mapping[str, Any], plain: Mapping[str, Any]) -> str:
    """Return in words how an estimator differs from the one that keeps the name."""
    missing = object()
    differing = {n: v for n, v in facts.items() if plain.get(n, missing) != v}
    code = differing.pop("code", None)
    parts = [f"{name}={value}" for name, value in differing.items()]
    parts += [f"without {name}" for name in plain if name not in facts]
    return ", ".join(parts + ([] if code is None else [f"code {code[:_SHOWN]}"]))


def _named_by_hash(rows: Sequence[Row]) -> list[Row]:
    """Return rows in which runs of one name and training seed in a game are named by their hashes,
    but for the latest."""
    latest: dict[tuple[Any, ...], tuple[str, str]] = {}
    for row in rows:
        line, version = _line(row), (row["date"], row["estimator_hash"])
        latest[line] = max(latest.get(line, version), version)
    renamed = []
    for row in rows:
        own = row["estimator_hash"]
        same = own == latest[_line(row)][1]
        changed = {} if same else {"estimator": f"{row['estimator']} (run {own[:_SHOWN]})"}
        renamed.append(row | changed)
    return renamed


def _line(row: Row) -> tuple[Any, ...]:
    """Return what identifies a line in the table of a game."""
    return (game_of(row), name_of(row), row["training_seed"])
