"""All tables of a leaderboard, computed once from stored scores, and their Markdown."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pinnobs_gym.leaderboard import ranks, ranks_table, standings_table
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.escapes import markdown_text
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.standings_table import Table
from pinnobs_gym.scoring.rows import Stored


@dataclass(frozen=True)
class Board:
    """The tables that the leaderboard command prints and writes."""

    tables: tuple[Table, ...]
    """One table per game, with failed jobs in its note."""
    lines: tuple[Line, ...]
    """The overview across systems."""
    ranks: Mapping[str, Mapping[str, int]]
    """Ranks of online estimators, by condition and estimator."""
    notes: tuple[str, ...] = ()
    """What was left out, a sentence each."""


def board(stored: Stored) -> Board:
    """Compute all tables from stored scores."""
    kept, notes = distinct(stored.rows)
    runs = runs_of(kept)
    compared = contenders(runs)
    return Board(
        tables=tuple(standings_table.tables(runs, stored.failures)),
        lines=tuple(ranks.lines(compared)),
        ranks=ranks.ranks(ranks.log_ratios(compared)),
        notes=notes,
    )


def markdown(board: Board) -> str:
    """Return the overview, the ranks and the table of every game in Markdown."""
    across = ranks_table.markdown(board.lines, board.ranks)
    notes = "".join(f"\n{markdown_text(note)}\n" for note in board.notes)
    return across + notes + "\n" + standings_table.markdown(board.tables)
