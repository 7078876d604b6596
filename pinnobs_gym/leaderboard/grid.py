"""A table of text, and the one way in which tables become plain text, Markdown, LaTeX or CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

from pinnobs_gym.leaderboard.display import filled, one_line, padded, printable, width_of
from pinnobs_gym.leaderboard.escapes import PACKAGES, csv_text, latex_text, markdown_text

GAP = "  "
"""What separates two columns of plain text."""
PROSE = 100
"""Width in characters at which sentences are wrapped where there is no terminal."""
WANTED = 3
"""Columns up to this priority are shown if a table has a layout with room for them (`fitting`)."""
DROPPED = "not shown at this width:"
"""What stands before the names of dropped columns."""


@dataclass(frozen=True)
class Column:
    """A column of a table."""

    name: str
    """Heading."""
    priority: int = 0
    """0 is never dropped; of the others, the highest number is dropped first from a table that is
    too wide, and of equal numbers the rightmost column."""
    numeric: bool = True
    """Whether cells are aligned at the right; otherwise at the left."""


@dataclass(frozen=True)
class Grid:
    """A table whose cells are text, whatever characters are in them.

    Raises:
        ValueError: in one line, if a line has more or fewer cells than there are columns.
    """

    title: str
    columns: tuple[Column, ...]
    lines: tuple[tuple[str, ...], ...]
    """Cells of each line."""
    blocks: tuple[int, ...] = ()
    """Indices of lines before which a rule is drawn."""
    note: str = ""
    """A remark below the table."""

    def __post_init__(self) -> None:
        for i, line in enumerate(self.lines):
            if len(line) != len(self.columns):
                expected = len(self.columns)
                raise ValueError(
                    f"line {i} of {self.title!r} has {len(line)} cells, not {expected}"
                )

    @property
    def header(self) -> tuple[str, ...]:
        """The headings."""
        return tuple(column.name for column in self.columns)

    def only(self, names: Sequence[str]) -> Grid:
        """Return the table with the columns of these names, in this order.

        Raises:
            ValueError: in one line, if there is no such column.
        """
        for name in names:
            if name not in self.header:
                known = ", ".join(self.header)
                raise ValueError(f"unknown column {name!r} of {self.title!r}; known are {known}")
        places = [self.header.index(name) for name in names]
        return replace(
            self,
            columns=tuple(self.columns[i] for i in places),
            lines=tuple(tuple(line[i] for i in places) for line in self.lines),
        )

    def fits(self, width: int | None, priority: int = 0) -> bool:
        """Return whether the columns of up to this priority, by default those that are never
        dropped, fit in this width, or in any width (None)."""
        kept = [i for i, column in enumerate(self.columns) if column.priority <= priority]
        return width is None or self._total(kept) <= width

    def text(self, width: int | None = None, hint: str = "") -> str:
        """Return the table as plain text.

        Columns are dropped by priority until the table fits, and a last line names them. No cell is
        ever cut or wrapped: if even the columns that are never dropped do not fit, each line
        becomes a record with a row ``heading: value`` per cell that is not empty.

        Args:
            width: of the terminal, in characters; None if there is no limit.
            hint: where the dropped columns are found, shown with their names.
        """
        whole = PROSE if width is None else width
        parts = [filled(map(printable, self.title.split()), whole)]
        dropped: list[str] = []
        if self.fits(width):
            shown = self._shown(width)
            dropped = [name for i, name in enumerate(self._cells[0]) if i not in shown]
            parts.append(self._table(shown))
        else:
            parts.append(self._records(whole))
        parts.append(filled(map(printable, self.note.split()), whole))
        if dropped:
            names = [f"{name}," for name in dropped[:-1]] + dropped[-1:]
            where = f"({printable(hint)})".split() if hint else []
            parts.append(filled([*DROPPED.split(), *names, *where], whole))
        return "\n".join(filter(None, parts))

    @cached_property
    def _cells(self) -> list[list[str]]:
        """The headings and the cells of each line as a terminal may show them."""
        return [[printable(cell) for cell in line] for line in (self.header, *self.lines)]

    @cached_property
    def _widths(self) -> list[int]:
        return [max(map(width_of, cells)) for cells in zip(*self._cells, strict=True)]

    def _total(self, shown: Sequence[int]) -> int:
        """Return the width of the table with these columns."""
        return sum(self._widths[i] for i in shown) + len(GAP) * max(len(shown) - 1, 0)

    def _shown(self, width: int | None) -> list[int]:
        """Return the indices of the columns that are shown in this width."""
        shown = list(range(len(self.columns)))
        last = sorted((c.priority, i) for i, c in enumerate(self.columns) if c.priority)
        while width is not None and self._total(shown) > width and last:
            shown.remove(last.pop()[1])
        return shown

    def _table(self, shown: Sequence[int]) -> str:
        """Return the table with these columns, a rule below the headings and before blocks."""
        header, *lines = (
            GAP.join(
                padded(cells[i], self._widths[i], right=self.columns[i].numeric) for i in shown
            ).rstrip()
            for cells in self._cells
        )
        rule = GAP.join("-" * self._widths[i] for i in shown)
        return "\n".join([header, rule, *self._ruled(lines, rule)])

    def _records(self, whole: int) -> str:
        """Return a record per line, with an empty line, or a rule before a block, between them."""
        header, *lines = self._cells
        names = [padded(f"{name}:", max(map(width_of, header)) + 1) for name in header]
        records = [
            "\n".join(f"{name} {cell}" for name, cell in zip(names, line, strict=True) if cell)
            for line in lines
        ]
        rule = "-" * min(whole, max(map(width_of, names), default=0))
        return "\n\n".join(self._ruled(records, rule))

    def _ruled(self, lines: Iterable[str], rule: str) -> list[str]:
        """Return lines with the rule before each block but the first line."""
        return [
            part
            for i, line in enumerate(lines)
            for part in ((rule, line) if i and i in self.blocks else (line,))
        ]

    def markdown(self) -> str:
        """Return the title as a heading, the table with all its columns, and the note."""
        heading = f"## {markdown_text(self.title)}" if self.title else ""
        table = text_table(self.header, self.lines)
        return "\n\n".join(filter(None, [heading, table, markdown_text(self.note)]))

    def latex(self) -> str:
        """Return a ``tabular`` of the package booktabs with all columns; see `only` for some of
        them. Title and note stand before it as comments."""
        kinds = "".join("r" if column.numeric else "l" for column in self.columns)
        header, *lines = (
            " & ".join(map(latex_text, line)) + r" \\" for line in (self.header, *self.lines)
        )
        parts = [
            *(f"% {one_line(text)}" for text in (self.title, self.note) if text),
            rf"% \usepackage{{{','.join(PACKAGES)}}}",
            rf"\begin{{tabular}}{{{kinds}}}",
            r"\toprule",
            header,
            r"\midrule",
            *self._ruled(lines, r"\midrule"),
            r"\bottomrule",
            r"\end{tabular}",
        ]
        return "\n".join(parts)

    def csv(self) -> str:
        """Return the headings and all lines as CSV (RFC 4180, but lines end in a line feed).

        Title and note are left out, and cells that look like formulas are changed as `csv_text`
        says; every other cell is read back as it is.
        """
        return "".join(map(_csv_line, (self.header, *self.lines)))


def _csv_line(cells: Iterable[str]) -> str:
    """Return a line of CSV. Only with this end does Python's writer quote every carriage return."""
    file, end = io.StringIO(newline=""), "\r\n"
    csv.writer(file, lineterminator=end).writerow(map(csv_text, cells))
    return file.getvalue().removesuffix(end) + "\n"


Layouts: TypeAlias = Sequence[Sequence[Grid]]
"""Ways to show one table, each as one or more grids; the first is one grid that has everything."""


def fitting(layouts: Layouts, width: int | None) -> Sequence[Grid]:
    """Return the layout that drops the fewest of its `WANTED` columns: the first whose grids all
    have room in this width for columns of up to that priority, or else up to the next lower one,
    and so on; otherwise the last."""
    for priority in range(WANTED, -1, -1):
        for grids in layouts:
            if all(grid.fits(width, priority) for grid in grids):
                return grids
    return layouts[-1]


def markdown_table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return one table in Markdown, of cells in Markdown."""
    rules = ["---"] * len(header)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rules, *lines))


def text_table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """Return one table in Markdown, of cells that are text, whatever characters are in them."""
    return markdown_table(
        [markdown_text(cell) for cell in header],
        ([markdown_text(cell) for cell in line] for line in lines),
    )
