"""The table of a CSV file: its columns as text and as numbers, with the lines that they are in."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pinnobs_gym.logs.csv_lines import shown, split_lines
from pinnobs_gym.simulation.values import LARGEST

_SHOWN = 60
"""Number of characters of a name that a list of names shows."""
_LISTED = 20
"""Number of names that a message lists."""


@dataclass(frozen=True)
class Table:
    """The cells of a CSV file below its header."""

    path: Path
    """The file."""
    header: list[str]
    """Names of the columns."""
    rows: list[list[str]]
    """The cells of each row, as many as the header has."""
    lines: np.ndarray
    """The line of each row in the file, shape (num_rows,)."""
    separator: str = ","
    """The character between cells."""
    kind: str = "log"
    """What the file is, as messages begin."""

    def place(self, row: int) -> str:
        """Return file and line of a row, as messages begin."""
        return f"{self.kind} {self.path}, line {self.lines[row]}"

    def cells(self, name: str) -> list[str]:
        """Return the cells of a column, without blanks around them.

        Raises:
            ValueError: in one line, if several columns have that name.
        """
        if self.header.count(name) > 1:
            raise ValueError(f"{self.kind} {self.path} has column {name} twice")
        column = self.header.index(name)
        return [row[column].strip() for row in self.rows]

    def numbers(self, name: str) -> np.ndarray:
        """Return the numbers of a column (num_rows,), NaN for an empty cell or ``nan``.

        Cells that are not separated by commas may have decimal commas, if none has a point.

        Raises:
            ValueError: in one line with the first cell that is not a finite number.
        """
        cells = self.cells(name)
        if self.decimal_commas(name):
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            found = np.array([number(cell or "nan") for cell in cells])
        except ValueError:
            found = np.array([_number_or_inf(cell) for cell in cells])
        wrong = np.flatnonzero(abs(found) > LARGEST)
        if len(wrong):
            k = wrong[0]
            place = f"{self.place(k)}: {name}={shown(self.cells(name)[k])}"
            if np.isfinite(found[k]):
                raise ValueError(
                    f"{place}; expected a number up to {LARGEST:g}, or an empty cell where a "
                    "sensor gave none"
                )
            raise ValueError(f"{place} is not a finite number")
        return found

    def decimal_commas(self, name: str) -> bool:
        """Return whether the numbers of a column have decimal commas: cells that are not separated
        by commas have some, and no points."""
        if self.separator == ",":
            return False
        text = "\n".join(self.cells(name))
        return "," in text and "." not in text


def number(text: str) -> float:
    """Return the number that a text is, as all programs read it: in digits from 0 to 9, without
    the underscores and the digits of other scripts that Python reads, too.

    Raises:
        ValueError: if it is none.
    """
    if "_" in text or not text.isascii():
        raise ValueError(f"{shown(text)} is not a number")
    return float(text)


def _number_or_inf(cell: str) -> float:
    """Return the number of a cell, and infinity if it is none."""
    try:
        return number(cell or "nan")
    except ValueError:
        return math.inf


def read_table(path: Path, kind: str = "log") -> Table:
    """Read a CSV file with a header. Its cells are separated by commas, semicolons or tabs: by what
    the header has most of. Lines without any text in their cells are left out.

    Args:
        path: the file.
        kind: what it is, as messages begin.

    Raises:
        ValueError: in one line that names the file and the line.
    """
    header: list[str] = []
    separator, rows, lines = ",", [], []
    for number, separator, cells in split_lines(path, kind):
        if not header:
            header = [name.strip() for name in cells]
        elif len(cells) != len(header):
            place = f"{kind} {path}, line {number}"
            raise ValueError(_miscounted(place, cells, header, separator))
        else:
            rows.append(cells)
            lines.append(number)
    if not header:
        raise ValueError(f"{kind} {path} is empty; expected a header and rows of numbers")
    if not rows:
        raise ValueError(f"{kind} {path} has a header but no rows")
    return Table(path, header, rows, np.array(lines), separator, kind)


def _miscounted(place: str, cells: list[str], header: list[str], separator: str) -> str:
    """Return the message for a line of too few or too many cells."""
    text = f"{place}: {len(cells)} cells; expected {len(header)}, as in the header"
    if len(header) == 1:
        text += f", which is {shown(header[0])}"
    if separator == "," and len(cells) > len(header) > 1:
        text += "; numbers with decimal commas need semicolons between them"
    return text


def quoted(argument: str) -> str:
    """Return an argument as it is written on a command line, of any system."""
    return argument if re.fullmatch(r"[\w=./+-]+", argument) else f'"{argument}"'


def listed(names: Sequence[str]) -> str:
    """Return names with commas between them, of which only the first are shown if they are many."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    short = (name if len(name) <= _SHOWN else f"{name[:_SHOWN]}..." for name in names[:_LISTED])
    return ", ".join(short) + more
