"""Stored scores told apart by the code and the settings that made them, before tables are made."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from pinnobs_gym.scoring.log_game import LOG_SETUP
from pinnobs_gym.scoring.recency import LastUse, facts_of
from pinnobs_gym.scoring.rows import Row, game_of
from pinnobs_gym.scoring.tuned import TUNED

_SHOWN = 6
"""Number of characters of a hash that are shown."""


class Distinct(NamedTuple):
    """Rows that may be compared under their names."""

    rows: list[Row]
    notes: tuple[str, ...]
    """What was left out, a sentence each."""


def distinct(rows: Sequence[Row], uses: Sequence[Row] = ()) -> Distinct:
    """Return the rows of the present code of each game, in which estimators that differ have names
    that differ.

    The present code is that used last (`pinnobs_gym.scoring.recency`). Episodes of a game whose
    code or settings have changed are not comparable: a note says what is left out. Names have the
    settings that are not the defaults. Of the estimators of one name that differ otherwise, in
    code, the one that was used last keeps the name, and the names of the others say what differs.
    Runs of a game that still look alike are named by their hashes.

    Args:
        rows: scored episodes.
        uses: rows of the kind ``use``.
    """
    last_use = LastUse.of([*rows, *uses])
    kept, notes = _of_present_games(rows, last_use)
    named = _named_by_difference(
        [_with_settings(row) for row in kept], [last_use.date(row) for row in kept]
    )
    return Distinct(_named_by_hash(named, [last_use.date(row) for row in kept]), notes)


def name_of(row: Row) -> str:
    """Return the name of a row's estimator, with its training budget."""
    budget = row["training"].get("config", {}).get("budget")
    return row["estimator"] if budget is None else f"{row['estimator']}, {budget:g} s"


def _with_settings(row: Row) -> Row:
    """Return a row in which the name of the estimator has the settings that are not the usual."""
    settings = ", ".join(f"{name}={value}" for name, value in row["settings"].items())
    return row | {"estimator": f"{row['estimator']} ({settings})"} if settings else row


def _of_present_games(rows: Sequence[Row], last_use: LastUse) -> tuple[list[Row], tuple[str, ...]]:
    """Return the rows of the present code of each game, and a note on those of other code."""
    present = {game: last_use.newest_game(game) for game in {game_of(row) for row in rows}}
    kept = [row for row in rows if row["game_hash"] == present[game_of(row)]]
    older = Counter(
        (game_of(row), row["game_hash"])
        for row in rows
        if row["game_hash"] != present[game_of(row)]
    )
    return kept, tuple(
        f"{count} episodes of {', '.join(game)} are left out: they are of {_other(game)} (hash "
        f"{other[:_SHOWN]}) than those used last ({present[game][:_SHOWN]})."
        for (game, other), count in sorted(older.items())
    )


def _other(game: tuple[str, str, str]) -> str:
    """Return in what the episodes of a game may differ."""
    told = "another noise or prior that estimators are told, or of " if game[1] == LOG_SETUP else ""
    return f"{told}other code or settings of the system, the simulation or the scores"


def _named_by_difference(rows: Sequence[Row], dates: Sequence[str]) -> list[Row]:
    """Return rows whose estimators are renamed where several have one name; dates are those of the
    last use of each row's code."""
    keys = [(name_of(row), json.dumps(_facts(row), sort_keys=True)) for row in rows]
    last: dict[tuple[str, str], str] = {}
    for key, date in zip(keys, dates, strict=True):
        last[key] = max(last.get(key, date), date)
    suffixes: dict[tuple[str, str], str] = {}
    for name in {name for name, _ in last}:
        variants = sorted((facts for n, facts in last if n == name), key=lambda f: last[name, f])
        plain = json.loads(variants[-1])
        for facts in variants[:-1]:
            suffixes[name, facts] = _difference(json.loads(facts), plain)
    return [
        row | {"estimator": f"{row['estimator']} ({suffixes[key]})"} if key in suffixes else row
        for row, key in zip(rows, keys, strict=True)
    ]


def _facts(row: Row) -> dict[str, Any]:
    """Return what may differ between estimators of one name, over all games. The settings of a
    tuned one are those of each system."""
    facts = facts_of(row)
    return {"code": facts["code"]} if TUNED in row["knows"] else facts


def _difference(facts: Mapping[str, Any], plain: Mapping[str, Any]) -> str:
    """Return in words how an estimator differs from the one that keeps the name."""
    missing = object()
    differing = {n: v for n, v in facts.items() if plain.get(n, missing) != v}
    code = differing.pop("code", None)
    parts = [f"{name}={value}" for name, value in differing.items()]
    parts += [f"without {name}" for name in plain if name not in facts]
    return ", ".join(parts + ([] if code is None else [f"code {code[:_SHOWN]}"]))


def _named_by_hash(rows: Sequence[Row], dates: Sequence[str]) -> list[Row]:
    """Return rows in which runs of one name and training seed in a game are named by their hashes,
    but for the one used last."""
    last: dict[tuple[Any, ...], tuple[str, str]] = {}
    for row, date in zip(rows, dates, strict=True):
        line, version = _line(row), (date, row["estimator_hash"])
        last[line] = max(last.get(line, version), version)
    renamed = []
    for row in rows:
        own = row["estimator_hash"]
        same = own == last[_line(row)][1]
        changed = {} if same else {"estimator": f"{row['estimator']} (run {own[:_SHOWN]})"}
        renamed.append(row | changed)
    return renamed


def _line(row: Row) -> tuple[Any, ...]:
    """Return what identifies a line in the table of a game."""
    return (game_of(row), name_of(row), row["training_seed"])
