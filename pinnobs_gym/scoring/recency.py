"""Which code of a game and of its estimators was used last, according to stored rows."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.scoring.rows import Row, game_of


@dataclass(frozen=True)
class LastUse:
    """The date of the last use of each code: when an episode was played with it, or taken from the
    rows file since it is the present one."""

    games: Mapping[tuple[GameName, str], str]
    """By game and ``game_hash``."""
    estimators: Mapping[tuple[GameName, str, str, str], str]
    """By game, ``game_hash``, name of the estimator and ``estimator_hash``."""
    variants: Mapping[tuple[GameName, str, str, str], tuple[str, str]]
    """`variant_of` scored rows, by the same."""

    @staticmethod
    def of(rows: Iterable[Row]) -> LastUse:
        """Collect the dates of scored rows and of rows of the kind ``use``."""
        games: dict[tuple[GameName, str], str] = {}
        estimators: dict[tuple[GameName, str, str, str], str] = {}
        variants: dict[tuple[GameName, str, str, str], tuple[str, str]] = {}
        for row in rows:
            game, date = game_of(row), row["date"]
            code = game, row["game_hash"]
            own = *code, row["estimator"], row["estimator_hash"]
            games[code] = max(games.get(code, date), date)
            estimators[own] = max(estimators.get(own, date), date)
            if own not in variants and row["kind"] == "score":
                variants[own] = variant_of(row)
        return LastUse(games, estimators, variants)

    def among(self, game: GameName) -> LastUse:
        """Return the dates of one game alone."""
        return LastUse(
            {key: date for key, date in self.games.items() if key[0] == game},
            {key: date for key, date in self.estimators.items() if key[0] == game},
            {key: variant for key, variant in self.variants.items() if key[0] == game},
        )

    @property
    def latest(self) -> str:
        """The latest date; empty if there is none."""
        return max(self.games.values(), default="")

    def newest_game(self, game: GameName) -> str:
        """Return the ``game_hash`` that was used last."""
        dates = {code: date for (other, code), date in self.games.items() if other == game}
        return max(dates, key=lambda code: (dates[code], code))

    def date(self, row: Row) -> str:
        """Return the date on which the code of a row was used last."""
        return self.estimators[
            (game_of(row), row["game_hash"], row["estimator"], row["estimator_hash"])
        ]

    def is_last(self, row: Row) -> bool:
        """Return whether no other code of its game was used later than that of a row, and none of
        its estimator: another training seed or other settings that its name shows are no other
        code."""
        code = game_of(row), row["game_hash"]
        name, variant = variant_of(row)
        own, others = "", ""
        for key, (other_name, other_variant) in self.variants.items():
            if key[:2] == code and other_name == name:
                date = self.estimators[key]
                if other_variant == variant:
                    own = max(own, date)
                else:
                    others = max(others, date)
        return self.newest_game(code[0]) == code[1] and own >= others


def facts_of(row: Row) -> dict[str, Any]:
    """Return what may differ between estimators of one name: settings and code. Trained ones may
    differ in their training seeds and still be one."""
    config = row["training"].get("config", {})
    trained = {name: value for name, value in config.items() if name not in ("seed", "budget")}
    if "condition" in row["training"]:
        trained["trained_under"] = row["training"]["condition"]
    settings = trained if row["training"] else row["options"]
    return {**settings, "code": row["estimator_code"]}


def variant_of(row: Row) -> tuple[str, str]:
    """Return what the name of a row's estimator says, and what it does not say, as text."""
    budget = row["training"].get("config", {}).get("budget")
    said = [row["estimator"], row["settings"], budget]
    return json.dumps(said, sort_keys=True), json.dumps(facts_of(row), sort_keys=True)
