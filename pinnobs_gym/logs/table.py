"""The table of a CSV file: its columns as text and as numbers, with the lines that they are in."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

_SHOWN = 60
"""Number of characters of a text that a message shows."""
_LISTED = 20
"""Number of names that a message lists."""
_SEPARATORS = {",": "commas", ";": "semicolons", "\t": "tabs"}


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
            found = np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            found = np.array([_float(cell) for cell in cells])
        wrong = np.flatnonzero(np.isinf(found))
        if len(wrong):
            cell = shown(self.cells(name)[wrong[0]])
            raise ValueError(f"{self.place(wrong[0])}: {name}={cell} is not a finite number")
        return found

    def decimal_commas(self, name: str) -> bool:
        """Return whether the numbers of a column have decimal commas: cells that are not separated
        by commas have some, and no points."""
        if self.separator == ",":
            return False
        text = "\n".join(self.cells(name))
        return "," in text and "." not in text


def _float(cell: str) -> float:
    """Return the number of a cell, and infinity if it is none."""
    try:
        return float(cell or "nan")
    except ValueError:
        return math.inf


def read_table(path: Path, kind: str = "log") -> Table:
    """Read a CSV file with a header. Its cells are separated by commas, semicolons or tabs: by what
    the header has most of. Lines without any text in their cells are left out.

    Each line is parsed by itself, as no cell of a log extends over several lines: a quote that is
    not closed is thus found in its own line, rather than at the end of the file.

    Args:
        path: the file.
        kind: what it is, as messages begin.

    Raises:
        ValueError: in one line that names the file and the line.
    """
    header: list[str] = []
    separator, rows, lines = ",", [], []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                if not header and line.strip():
                    separator = max(_SEPARATORS, key=line.count)
                cells = _parsed(line, separator, f"{kind} {path}, line {number}")
                if not any(cell.strip() for cell in cells):
                    continue
                if not header:
                    header = [name.strip() for name in cells]
                    continue
                if len(cells) != len(header):
                    raise ValueError(
                        _miscounted(f"{kind} {path}, line {number}", cells, header, separator)
                    )
                rows.append(cells)
                lines.append(number)
    except UnicodeDecodeError as error:
        raise ValueError(f"cannot read {kind} {path}: {error}; expected a text in UTF-8") from None
    except OSError as error:
        raise ValueError(f"cannot read {kind} {path}: {error}") from None
    if not header:
        raise ValueError(f"{kind} {path} is empty; expected a header and rows of numbers")
    if not rows:
        raise ValueError(f"{kind} {path} has a header but no rows")
    return Table(path, header, rows, np.array(lines), separator, kind)


def _parsed(line: str, separator: str, place: str) -> list[str]:
    try:
        return next(csv.reader([line], strict=True, delimiter=separator), [])
    except csv.Error as error:
        raise ValueError(
            f"{place}: {shown(line)} is no line of a CSV file ({error}); expected every quote to "
            "be closed in its line"
        ) from None


def _miscounted(place: str, cells: list[str], header: list[str], separator: str) -> str:
    """Return the message for a line of too few or too many cells."""
    text = f"{place}: {len(cells)} cells; expected {len(header)}, as in the header"
    if len(header) == 1:
        text += f", which is {shown(header[0])}"
    if separator == "," and len(cells) > len(header) > 1:
        text += "; numbers with decimal commas need semicolons between them"
    return text


def shown(text: str) -> str:
    """Return the representation of a text, of which only the beginning is shown if it is long."""
    text = text.strip()
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def quoted(argument: str) -> str:
    """Return an argument as it is written on a command line, of any system."""
    return argument if re.fullmatch(r"[\w=./+-]+", argument) else f'"{argument}"'


def listed(names: Sequence[str]) -> str:
    """Return names with commas between them, of which only the first are shown if they are many."""
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    short = (name if len(name) <= _SHOWN else f"{name[:_SHOWN]}..." for name in names[:_LISTED])
    return ", ".join(short) + more
