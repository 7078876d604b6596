"""Which code of a game and of its estimators was used last, according to stored rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

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

    @staticmethod
    def of(rows: Iterable[Row]) -> LastUse:
        """Collect the dates of scored rows and of rows of the kind ``use``."""
        games: dict[tuple[GameName, str], str] = {}
        estimators: dict[tuple[GameName, str, str, str], str] = {}
        for row in rows:
            game, date = game_of(row), row["date"]
            code = game, row["game_hash"]
            own = *code, row["estimator"], row["estimator_hash"]
            games[code] = max(games.get(code, date), date)
            estimators[own] = max(estimators.get(own, date), date)
        return LastUse(games, estimators)

    def among(self, game: GameName) -> LastUse:
        """Return the dates of one game alone."""
        return LastUse(
            {key: date for key, date in self.games.items() if key[0] == game},
            {key: date for key, date in self.estimators.items() if key[0] == game},
        )

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
        """Return whether no other code of its game, and none of its estimator, was used later than
        that of a row."""
        game, code, name = game_of(row), row["game_hash"], row["estimator"]
        others = {
            key: date for key, date in self.estimators.items() if key[:3] == (game, code, name)
        }
        return self.newest_game(game) == code and self.date(row) == max(others.values())
