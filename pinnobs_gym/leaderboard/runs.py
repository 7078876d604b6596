"""Stored scores grouped by game and configuration; each line of a game's table is one run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.floor import NO_FLOOR, NO_FLOORS, Floor, Floors
from pinnobs_gym.leaderboard.standings import Standing, is_identifiable, standing
from pinnobs_gym.scoring.row_format import SUBMITTED
from pinnobs_gym.scoring.rows import Row, game_of


@dataclass(frozen=True, eq=False)
class ScoredRun:
    """The episodes of one game that one estimator played with one configuration."""

    game: GameName
    rows: list[Row]
    """The scored rows, at least one."""
    position: int
    """Index of its first row among all stored rows."""
    floor: Floor = NO_FLOOR
    """The floor of the game for estimators of its track."""

    @property
    def estimator(self) -> str:
        """The estimator's name in rows."""
        return self.rows[0]["estimator"]

    @property
    def hashes(self) -> tuple[str, str]:
        """Hashes of the game and of the estimator; see `pinnobs_gym.scoring.row_format.Row`."""
        return self.rows[0]["game_hash"], self.rows[0]["estimator_hash"]

    @property
    def track(self) -> str:
        """``online`` or ``offline``, or a track apart (`pinnobs_gym.scoring.row_format.Row`)."""
        return self.rows[0]["track"]

    @property
    def submitted(self) -> bool:
        """Whether the estimates were made elsewhere (`pinnobs_gym.scoring.submitted`)."""
        return SUBMITTED in self.rows[0]["knows"]

    @property
    def ranked(self) -> bool:
        """Whether the system is ranked under the condition of this run."""
        return self.rows[0]["ranked"]

    @property
    def identifiable(self) -> bool:
        """Whether the states can be told from the outputs in this game."""
        return is_identifiable(self.rows[0])

    @property
    def per_record(self) -> bool:
        """Whether the estimator is trained on each record that it estimates."""
        return bool(self.rows[0]["training"].get("per_record"))

    @cached_property
    def standing(self) -> Standing:
        """The summary of its rows, computed on first use."""
        return standing(self.rows, self.floor)


def runs_of(rows: Iterable[Row], floors: Floors = NO_FLOORS) -> list[ScoredRun]:
    """Group scored episodes into runs, in the order of their first rows, each with its floor."""
    runs: dict[tuple[GameName, str, str, str], ScoredRun] = {}
    for position, row in enumerate(rows):
        key = (game_of(row), row["game_hash"], row["estimator"], row["estimator_hash"])
        if key not in runs:
            runs[key] = ScoredRun(key[0], [], position, floors.of(key[0], row["track"]))
        runs[key].rows.append(row)
    return list(runs.values())


def apart(runs: Sequence[ScoredRun]) -> tuple[list[ScoredRun], list[ScoredRun]]:
    """Return the runs of estimators that are made before any record is seen; and, if there are
    others, the runs on the records on which those were trained: theirs, and those of all estimators
    restricted to the same episodes."""
    own: dict[GameName, list[set[str]]] = defaultdict(list)
    for run in runs:
        if run.per_record:
            own[run.game].append({row["episode"] for row in run.rows})
    common = {game: set.intersection(*episodes) for game, episodes in own.items()}
    on_record = []
    for run in runs:
        wanted = None if run.per_record else common.get(run.game, set())
        rows = [row for row in run.rows if wanted is None or row["episode"] in wanted]
        on_record += [replace(run, rows=rows)] if rows else []
    return [run for run in runs if not run.per_record], on_record if own else []


def rows_of(runs: Iterable[ScoredRun]) -> list[Row]:
    """Return the rows of all these runs."""
    return list(chain.from_iterable(run.rows for run in runs))
