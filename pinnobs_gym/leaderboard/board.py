"""All tables of a leaderboard, computed once from stored scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.contenders import Contender, contenders
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.places import Places
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.runs import ScoredRun, apart, runs_of
from pinnobs_gym.leaderboard.tables import Table, tables
from pinnobs_gym.scoring.rows import Row, Stored


@dataclass(frozen=True)
class Part:
    """Tables of estimators that can be compared with each other."""

    contenders: tuple[Contender, ...]
    tables: tuple[Table, ...]
    """One table per game, with failed jobs in its note."""
    lines: tuple[Line, ...]
    """The overview across systems, under the condition that each is ranked under."""
    places: Places
    """The places of the overview."""
    conditions: Mapping[str, Places]
    """Places of online estimators under each condition, over all systems."""

    @property
    def knows(self) -> dict[str, tuple[str, ...]]:
        """What each estimator knows, the most in any game."""
        return {
            each.name: max((tuple(run.rows[0]["knows"]) for run in each.runs), key=len)
            for each in self.contenders
        }


@dataclass(frozen=True)
class Board:
    """The tables that the leaderboard command prints and writes."""

    main: Part
    """Estimators that are made before any scored record is seen."""
    on_record: Part | None
    """Estimators that are trained on each record by itself, with all others on the same episodes;
    None if there are none."""
    notes: tuple[str, ...] = ()
    """What was left out, a sentence each."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that there are."""
        return (self.main,) if self.on_record is None else (self.main, self.on_record)


def board(stored: Stored) -> Board:
    """Compute all tables from stored scores."""
    kept, notes = distinct(stored.rows, stored.uses)
    made_before, on_record = apart(runs_of(kept))
    main = _part(made_before, stored.failures)
    return Board(main, _part(on_record, ()) if on_record else None, notes)


def _part(runs: Sequence[ScoredRun], failures: Sequence[Row]) -> Part:
    """Compute the tables of runs that can be compared."""
    compared = contenders(runs)
    lines, places = ranks.lines(compared)
    return Part(
        contenders=tuple(compared),
        tables=tuple(tables(compared, failures)),
        lines=tuple(lines),
        places=places,
        conditions=ranks.by_condition(compared),
    )
