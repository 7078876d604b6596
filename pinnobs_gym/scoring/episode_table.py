"""Tables of samples as files: a line per episode and sample, in CSV or in Parquet."""

from __future__ import annotations

import csv
import importlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from pinnobs_gym.logs.csv_lines import split_lines

Format: TypeAlias = Literal["csv", "parquet"]
"""The formats of tables, which are also the suffixes of their files."""
_LONGEST_SHOWN = 40
"""Largest number of characters that an error shows of a cell."""


@contextmanager
def writing(
    path: Path, names: Sequence[str]
) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
    """Open a new table, and yield the function that appends lines to it: columns (n,) by name.

    Numbers are written with all their digits, so that they are read back without loss. NaN is an
    empty cell in CSV, and null in Parquet. A table in Parquet has a group of rows per call.

    Args:
        path: the file; its suffix is the format.
        names: names of the columns, in their order.

    Raises:
        ValueError: in one line, if the format is Parquet and PyArrow is not installed.
    """
    if path.suffix == ".parquet":
        with _writing_parquet(path, names) as append:
            yield append
        return
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)

        def append_lines(columns: Mapping[str, np.ndarray]) -> None:
            cells = [_cells(columns[name]) for name in names]
            writer.writerows(zip(*cells, strict=True))

        yield append_lines


def _cells(column: np.ndarray) -> list[Any]:
    """Return the numbers of a column, with None, an empty cell, in place of NaN."""
    values = column.tolist()
    if column.dtype.kind != "f" or not np.isnan(column).any():
        return values
    return [None if math.isnan(value) else value for value in values]


@contextmanager
def _writing_parquet(
    path: Path, names: Sequence[str]
) -> Iterator[Callable[[Mapping[str, np.ndarray]], None]]:
    arrow, parquet = parquet_library()
    kinds = {name: arrow.int64() if name == "episode" else arrow.float64() for name in names}
    schema = arrow.schema(list(kinds.items()))
    with parquet.ParquetWriter(path, schema) as writer:

        def append(columns: Mapping[str, np.ndarray]) -> None:
            arrays = [
                arrow.array(columns[name], type=kind, from_pandas=True)  # NaN becomes null
                for name, kind in kinds.items()
            ]
            writer.write_table(arrow.Table.from_arrays(arrays, schema=schema))

        yield append


def parquet_library() -> tuple[Any, Any]:
    """Return the modules ``pyarrow`` and ``pyarrow.parquet``.

    Raises:
        ValueError: in one line that names the extra, if PyArrow is not installed.
    """
    try:
        return importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
    except ImportError:
        raise ValueError(
            'Parquet needs PyArrow; install it with pip install "pinnobs-gym[parquet]"'
        ) from None


@dataclass(frozen=True)
class Cells:
    """The content of a table, not yet converted to numbers."""

    path: Path
    names: list[str]
    """Names of the columns, in their order."""
    columns: dict[str, list[Any]]
    """Cells by column: texts of a CSV file; numbers or None of a Parquet file."""
    lines: Sequence[int]
    """Number of the line, or of the row of a Parquet file, that each cell is in."""

    def place(self, i: int) -> str:
        """Return the file and the line of cell i, for messages."""
        return f"{self.path}, {'row' if self.path.suffix == '.parquet' else 'line'} {self.lines[i]}"


def read_cells(path: Path) -> Cells:
    """Read a table. Blank lines of a CSV file do not count.

    Raises:
        ValueError: in one line that names the file and the line, if the file cannot be read, has no
            header or no rows, or a line has another number of cells than the header.
    """
    if not path.is_file():
        raise ValueError(f"there is no file {path}")
    if path.suffix == ".parquet":
        return _read_parquet(path)
    lines, rows, separator = [], [], ","
    for number, between, cells in split_lines(path, "estimates"):
        separator = between
        lines.append(number)
        rows.append(cells)
    if separator != ",":
        kind = "semicolons" if separator == ";" else "tabs"
        raise ValueError(f"{path} is separated by {kind}; expected commas")
    if len(rows) < 2:
        raise ValueError(f"{path} has no rows; expected a header and a line per sample")
    names = [name.strip() for name in rows[0]]
    for number, cells in zip(lines, rows, strict=True):
        if len(cells) != len(names):
            raise ValueError(f"{path}, line {number}: {len(cells)} cells; expected {len(names)}")
    columns = dict(zip(names, map(list, zip(*rows[1:], strict=True)), strict=False))
    return Cells(path, names, columns, lines[1:])


def _read_parquet(path: Path) -> Cells:
    arrow, parquet = parquet_library()
    try:
        table = parquet.read_table(path)
    except (OSError, arrow.ArrowException) as error:
        what = " ".join(str(error).split())
        raise ValueError(f"cannot read {path}: {what}") from None
    if not table.num_rows:
        raise ValueError(f"{path} has no rows; expected one per sample")
    columns = {name: table.column(name).to_pylist() for name in dict.fromkeys(table.column_names)}
    return Cells(path, list(table.column_names), columns, range(1, table.num_rows + 1))


def shown(cell: object) -> str:
    """Return how an error shows a cell, of which only the beginning is shown if it is long."""
    text = repr(cell.strip() if isinstance(cell, str) else cell)
    return text if len(text) <= _LONGEST_SHOWN else f"{text[: _LONGEST_SHOWN - 3]}..."
