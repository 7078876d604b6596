"""`tables ROWS`: print a leaderboard's tables as text, Markdown, LaTeX or CSV."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pinnobs_gym.cli.console import console, print_next, table_width
from pinnobs_gym.cli.options import parse
from pinnobs_gym.files import replacing
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import Chapter, chapters
from pinnobs_gym.leaderboard.display import printable
from pinnobs_gym.leaderboard.grid import Grid, Layouts
from pinnobs_gym.leaderboard.published.reading import load_rows, published_floors
from pinnobs_gym.leaderboard.tables import Table
from pinnobs_gym.scoring.rows import game_of


@dataclass(frozen=True)
class Tables:
    """Print the tables of stored scores. As text they are as wide as the terminal or the
    environment variable COLUMNS; a pipe and a file get all columns, as other formats do."""

    rows: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Rows files, such as runs/leaderboard/rows.jsonl; published stands for the rows that ship with
    the package."""
    format: Literal["text", "markdown", "latex", "csv"] = "text"
    """Format; csv holds one table, and latex needs the packages that it names."""
    table: tuple[str, ...] = ()
    """Tables: overview, ranks, or a system, where wanted with a setup and a condition in any order,
    such as InductionMotor,load_step or ReverseDuffing,paper; all with their explanations if none is
    named. With "on-record " before it, overview or a system is that of estimators which are trained
    on each record."""
    columns: tuple[str, ...] = ()
    """Headings of the columns, in their order; all if none is named."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write; otherwise the tables are printed."""

    def run(self) -> int:
        """Print or write the tables."""
        if not self.rows:
            raise ValueError(
                "no rows file is given; expected one, such as runs/leaderboard/rows.jsonl"
            )
        stored = load_rows(self.rows)
        if not stored.rows and not stored.failures:
            raise ValueError(f"no scored episodes in {', '.join(map(str, self.rows))}")
        results = board(stored, published_floors({game_of(row) for row in stored.rows}))
        found = chapters(results)
        text = self._text(chosen(found, self.table) if self.table else found)
        for note in filter(None, (stored.warning, *results.notes)):
            print(printable(note), file=sys.stderr)
        if self.out is None:
            lines = text.split("\n")  # control characters of CSV are for files only
            print("\n".join(map(printable, lines) if console.is_terminal else lines))
            if console.is_terminal:  # elsewhere the tables alone
                print_next("report", *self.rows, "-o", "site")
            return 0
        with replacing(self.out) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8", errors="replace", newline="\n")
        console.print(f"tables: {self.out}", soft_wrap=True)
        print_next("report", *self.rows, "-o", "site")
        return 0

    def _text(self, found: Sequence[Chapter]) -> str:
        """Return the tables in the format, without a line break at the end."""
        if self.columns:
            found = [replace(chapter, tables=self._narrowed(chapter)) for chapter in found]
        if self.format == "text":
            width = table_width() if self.out is None else None
            return "\n\n".join(chapter.text(width, "-o FILE writes all") for chapter in found)
        if self.format == "markdown":
            return "\n\n".join(map(Chapter.markdown, found))
        whole = [layouts[0][0] for chapter in found for layouts in chapter.tables]
        if self.format == "latex":
            return "\n\n".join(map(Grid.latex, whole))
        if len(whole) > 1:
            titles = "; ".join(grid.title for grid in whole)
            raise ValueError(f"csv holds one table, not {len(whole)} ({titles}); choose by --table")
        return whole[0].csv().removesuffix("\n")

    def _narrowed(self, chapter: Chapter) -> tuple[Layouts, ...]:
        """Return the tables of a chapter with the chosen columns."""
        return tuple([[layouts[0][0].only(self.columns)]] for layouts in chapter.tables)


ON_RECORD = "on-record "
"""What stands before the names of tables of estimators that are trained on each record."""


def chosen(found: Sequence[Chapter], names: Sequence[str]) -> list[Chapter]:
    """Return the tables of these names, each in a chapter without title and explanation.

    Raises:
        ValueError: in one line, if there is no such table.
    """
    across = {chapter.key: chapter for chapter in found if not chapter.games}
    return [
        replace(across[name] if name in across else _of_game(found, name), title="", note="")
        for name in names
    ]


def _of_game(found: Sequence[Chapter], name: str) -> Chapter:
    """Return the tables of a system or, with commas between, of the system in a setup, under a
    condition, or both; of the estimators that are trained on each record if the name says so."""
    prefix = ON_RECORD if name.startswith(ON_RECORD) else ""
    system, *wanted = (part.strip() for part in name.removeprefix(prefix).split(","))
    games = next((chapter for chapter in found if chapter.key == f"{prefix}games"), None)
    own = [] if games is None else [table for table in games.games if system in _names(table)]
    if games is None or not own:
        raise ValueError(f"unknown table {name!r}; known are {', '.join(_known(found))}")
    kept = [table for table in own if all(_is_of(table, part) for part in wanted)]
    if not kept:
        played = (f"{system},{table.game.setup},{table.game.condition}" for table in own)
        known = ", ".join(repr(f"{prefix}{each}") for each in played)
        raise ValueError(f"no table {name!r}; known are {known}")
    pairs = zip(games.games, games.tables, strict=True)
    layouts = tuple(own for table, own in pairs if any(table is each for each in kept))
    return replace(games, tables=layouts, games=tuple(kept))


def _known(found: Sequence[Chapter]) -> list[str]:
    """Return the names of all tables, those of games without setups and conditions."""
    names: dict[str, None] = {}
    for chapter in found:
        prefix = ON_RECORD if chapter.key.startswith(ON_RECORD) else ""
        systems = [f"{prefix}{table.game.system}" for table in chapter.games]
        names |= dict.fromkeys(systems or [chapter.key])
    return sorted(names, key=lambda name: name.startswith(ON_RECORD))


def _names(table: Table) -> tuple[str, str, str]:
    """Return the names of a table's system, with and without namespace and version."""
    game = table.game
    return game.env_id, game.system, game.system.rpartition("-v")[0]


def _is_of(table: Table, part: str) -> bool:
    """Return whether a part of a name is the setup or the condition of a table; the parts of a
    condition may be joined in any order."""
    condition = sorted(table.game.condition.split("+"))
    return part == table.game.setup or sorted(part.split("+")) == condition


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Tables, "tables", arguments).run()
