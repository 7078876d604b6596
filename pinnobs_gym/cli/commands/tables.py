"""`tables ROWS`: print a leaderboard's tables as text, Markdown, LaTeX or CSV."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pinnobs_gym.cli.console import console, table_width
from pinnobs_gym.cli.options import parse
from pinnobs_gym.files import replacing
from pinnobs_gym.leaderboard.board import Board, board
from pinnobs_gym.leaderboard.chapters import chapters
from pinnobs_gym.leaderboard.display import printable
from pinnobs_gym.leaderboard.grid import Grid, Layouts, fitting
from pinnobs_gym.leaderboard.tables import Table
from pinnobs_gym.scoring import rows


@dataclass(frozen=True)
class Tables:
    """Print the tables of stored scores. As text they are as wide as the terminal or the
    environment variable COLUMNS; a pipe and a file get all columns, as other formats do."""

    rows: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Rows files, such as runs/leaderboard/rows.jsonl."""
    format: Literal["text", "markdown", "latex", "csv"] = "text"
    """Format; csv holds one table, and latex needs the packages that it names."""
    table: tuple[str, ...] = ()
    """Tables: overview, ranks, or a system with or without a condition, such as
    InductionMotor,load_step; all if none is named. On-record overview is that of estimators which
    are trained on each record."""
    columns: tuple[str, ...] = ()
    """Headings of the columns, in their order; all if none is named."""
    out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None
    """File to write; otherwise the tables are printed."""

    def run(self) -> int:
        """Print or write the tables."""
        if not self.rows:
            raise ValueError("no rows file is given; such as runs/leaderboard/rows.jsonl")
        stored = rows.load_all(self.rows)
        if not stored.rows and not stored.failures:
            raise ValueError(f"no scored episodes in {', '.join(map(str, self.rows))}")
        results = board(stored)
        text = self._text(chosen(results, self.table))
        for note in filter(None, (stored.warning, *results.notes)):
            print(printable(note), file=sys.stderr)
        if self.out is None:
            lines = text.split("\n")  # control characters of CSV are for files only
            print("\n".join(map(printable, lines) if console.is_terminal else lines))
            return 0
        with replacing(self.out) as temporary:
            temporary.write_text(text + "\n", encoding="utf-8", errors="replace", newline="\n")
        console.print(f"tables: {self.out}", soft_wrap=True)
        return 0

    def _text(self, tables: Sequence[Layouts]) -> str:
        """Return the tables in the format, without a line break at the end."""
        if self.format == "csv" and len(tables) > 1:
            titles = "; ".join(layouts[0][0].title for layouts in tables)
            raise ValueError(
                f"csv holds one table, not {len(tables)} ({titles}); choose by --table"
            )
        if self.columns:
            tables = [[[layouts[0][0].only(self.columns)]] for layouts in tables]
        if self.format == "text":
            width = table_width() if self.out is None else None
            shown = [grid for layouts in tables for grid in fitting(layouts, width)]
            return "\n\n".join(grid.text(width, "-o FILE writes all") for grid in shown)
        whole = [layouts[0][0] for layouts in tables]
        write = {"markdown": Grid.markdown, "latex": Grid.latex, "csv": Grid.csv}[self.format]
        return "\n\n".join(map(write, whole)).removesuffix("\n")


def chosen(results: Board, names: Sequence[str]) -> list[Layouts]:
    """Return the tables of these names, or all of them: the overview, the ranks if there are
    several conditions, and those of all games; then the same on the records of estimators that are
    trained on each.

    Raises:
        ValueError: in one line, if there is no such table.
    """
    found = chapters(results)
    if not names:
        return [layouts for chapter in found for layouts in chapter.tables]
    across = {c.key: c.tables for c in found if not c.games}
    games = [pair for c in found if c.games for pair in zip(c.games, c.tables, strict=True)]
    shown: list[Layouts] = []
    for name in names:
        if name in across:
            shown += across[name]
        else:
            wanted = _of_game([table for table, _ in games], name, known=across)
            shown += [layouts for table, layouts in games if any(table is each for each in wanted)]
    return shown


def _of_game(tables: Sequence[Table], name: str, known: Iterable[str]) -> list[Table]:
    """Return the tables of a ``system`` or a ``system,condition`` in any setup."""
    system, comma, condition = (part.strip() for part in name.partition(","))
    own = [table for table in tables if system in _names(table)]
    if not own:
        systems = dict.fromkeys(table.game.system for table in tables)
        raise ValueError(f"unknown table {name!r}; known are {', '.join([*known, *systems])}")
    if not comma:
        return own
    found = [t for t in own if _parts(t.game.condition) == _parts(condition)]
    if not found:
        played = ", ".join(dict.fromkeys(table.game.condition for table in own))
        raise ValueError(f"no table {name!r}; {system} was played under {played}")
    return found


def _names(table: Table) -> tuple[str, str, str]:
    """Return the names of a table's system, with and without namespace and version."""
    game = table.game
    return game.env_id, game.system, game.system.rpartition("-v")[0]


def _parts(condition: str) -> list[str]:
    """Return the parts of a condition, which may be joined in any order."""
    return sorted(condition.split("+"))


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Tables, "tables", arguments).run()
