"""All tables of a leaderboard, computed once from stored scores."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.contenders import Contender, among, contenders
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.floor import NO_FLOORS, Floors, contending, floors
from pinnobs_gym.leaderboard.places import Places
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.runs import ScoredRun, apart, runs_of
from pinnobs_gym.leaderboard.tables import Table, tables
from pinnobs_gym.scoring.rows import Row, Stored


@dataclass(frozen=True)
class Part:
    """Tables of estimators that can be compared with each other."""

    contenders: tuple[Contender, ...]
    setup: str
    """The setup of all that is across systems; empty without scores."""
    compared: tuple[Contender, ...]
    """The contenders restricted to the games of this setup."""
    tables: tuple[Table, ...]
    """One table per game, with failed jobs in its note."""
    lines: tuple[Line, ...]
    """The overview across systems, under the condition that each is ranked under."""
    places: Places
    """The places of the overview."""
    conditions: Mapping[str, Places]
    """Places of online estimators under each condition, over all systems of the setup."""

    @property
    def knows(self) -> dict[str, tuple[str, ...]]:
        """What each estimator knows, the most in any game."""
        return {
            each.name: max((tuple(run.rows[0]["knows"]) for run in each.runs), key=len)
            for each in self.contenders
        }

    @property
    def note(self) -> str:
        """A sentence about the setups that are in the tables of their games only; possibly
        empty."""
        others = sorted({table.game.setup for table in self.tables if table.entries} - {self.setup})
        if not others:
            return ""
        return (
            f"The overview and the ranks are of the setup {self.setup}; in the tables of their "
            f"games only: {', '.join(others)}."
        )


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
    floors: Floors = NO_FLOORS
    """The floors of errors of all games, which no table ranks."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts that there are."""
        return (self.main,) if self.on_record is None else (self.main, self.on_record)


def board(stored: Stored, shipped: Sequence[Row] = ()) -> Board:
    """Compute all tables from stored scores, some of which may be floors, and further rows of
    floors (`pinnobs_gym.leaderboard.floor.floors`)."""
    kept, notes = distinct(stored.rows, stored.uses)
    found = floors(kept, shipped)
    made_before, on_record = apart(runs_of(contending(kept), found))
    main = _part(made_before, stored.failures, found)
    own_floors = found.among({run.game for run in on_record})
    second = _part(on_record, (), own_floors) if on_record else None
    own = [main.note] if main.note else []
    if second is not None and second.note:
        own.append(f"Trained on each record: {second.note}")
    return Board(main, second, (*notes, *found.notes, *own), found)


def _part(runs: Sequence[ScoredRun], failures: Sequence[Row], found_floors: Floors) -> Part:
    """Compute the tables of runs that can be compared."""
    found, setup = contenders(runs), _setup(runs)
    compared = among(found, lambda run: run.game.setup == setup)
    lines, places = ranks.lines(compared)
    return Part(
        contenders=tuple(found),
        setup=setup,
        compared=tuple(compared),
        tables=tuple(tables(found, failures, found_floors)),
        lines=tuple(lines),
        places=places,
        conditions=ranks.by_condition(compared),
    )


def _setup(runs: Sequence[ScoredRun]) -> str:
    """Return the setup over which systems are compared: ``benchmark`` if it was played, or else
    that with the most rows; the games of several setups of one system are not as many systems."""
    played: Counter[str] = Counter()
    for run in runs:
        played[run.game.setup] += len(run.rows)
    if "benchmark" in played:
        return "benchmark"
    return max(played, key=lambda setup: played[setup], default="")
