"""The tables of a leaderboard in the order in which they are shown, with their explanations."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pinnobs_gym.leaderboard import ranks_table, standings_table
from pinnobs_gym.leaderboard.board import Board, Part
from pinnobs_gym.leaderboard.display import filled
from pinnobs_gym.leaderboard.escapes import markdown_text
from pinnobs_gym.leaderboard.grid import PROSE, Layouts, fitting
from pinnobs_gym.leaderboard.tables import Table

ON_RECORD = (
    "Estimators that are trained on each record by itself, and all others on the same episodes. A "
    "training serves one record only, so that these have tables and ranks of their own."
)
"""Explanation of the second part."""


@dataclass(frozen=True)
class Chapter:
    """Tables with a common explanation."""

    key: str
    """``overview``, ``ranks`` or ``games``; of the second part with ``on-record `` before it."""
    title: str
    note: str
    """The explanation, in Markdown."""
    tables: tuple[Layouts, ...]
    games: tuple[Table, ...] = ()
    """The games of the tables, if each is of one game."""

    def text(self, width: int | None = None, hint: str = "") -> str:
        """Return the tables as plain text, with the explanation below them; see `Grid.text`."""
        parts = [grid.text(width, hint) for each in self.tables for grid in fitting(each, width)]
        parts.append(filled(self.note.split(), PROSE if width is None else width))
        return "\n\n".join(filter(None, parts))

    def markdown(self) -> str:
        """Return title, explanation and tables in Markdown."""
        title = f"# {self.title}" if self.title else ""
        parts = [title, self.note, *(layouts[0][0].markdown() for layouts in self.tables)]
        return "\n\n".join(filter(None, parts))


def chapters(board: Board) -> list[Chapter]:
    """Return the chapters of a leaderboard: overview, ranks by condition and games, first of the
    estimators that are made before any record is seen, then, without ranks by condition, on the
    records of the others."""
    found = _chapters(board.main, "", "", "")
    if board.on_record is not None:
        found += _chapters(board.on_record, "on-record ", ", trained on each record", ON_RECORD)
    return found


def markdown(board: Board) -> str:
    """Return all tables of a leaderboard in Markdown."""
    parts = [chapter.markdown() for chapter in chapters(board)]
    return "\n\n".join([*parts, *map(markdown_text, board.notes)]) + "\n"


def _chapters(part: Part, key: str, title: str, note: str) -> list[Chapter]:
    """Return the chapters of one part, with these additions to their keys, titles (and those of
    their tables) and notes."""

    def noted(own: str) -> str:
        return " ".join(filter(None, (note, own)))

    def titled(layouts: Layouts) -> Layouts:
        return [[replace(grid, title=grid.title + title) for grid in grids] for grids in layouts]

    found = []
    if part.lines:
        overview = titled(ranks_table.layouts(part.lines, part.places.peer))
        found.append(
            Chapter(f"{key}overview", f"Leaderboard{title}", noted(ranks_table.NOTE), (overview,))
        )
    if len(part.conditions) > 1 and not key:  # no online estimator is trained on a record
        ranks = titled(ranks_table.rank_layouts(part.conditions, part.knows))
        found.append(
            Chapter(f"{key}ranks", f"Conditions{title}", noted(ranks_table.RANK_NOTE), (ranks,))
        )
    if part.tables:
        tables = tuple(titled(standings_table.layouts(table)) for table in part.tables)
        note = noted(standings_table.NOTE)
        found.append(Chapter(f"{key}games", f"Each game{title}", note, tables, part.tables))
    return found
