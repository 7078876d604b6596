"""The reading of sensor logs."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from pinnobs_gym.simulation.motion import check_steps
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System

_SHOWN = 60
"""Number of characters of a text that a message shows."""


@dataclass(frozen=True)
class Log:
    """A sensor log as a record of one row."""

    path: Path
    """The file."""
    system: System
    """The model, with `System.measured_input` set if the file has inputs."""
    record: Record
    """The samples."""
    lines: np.ndarray
    """The line of each sample in the file, shape (num_samples,)."""
    notes: tuple[str, ...] = ()
    """Lines to tell the user, such as the columns that are not used."""
    start: datetime | None = None
    """The instant of the first sample, t = 0, of a file with dates; None for numbers."""


def read_log(path: str | Path, system: System, prior: Prior, columns: Sequence[str] = ()) -> Log:
    """Read a log from a CSV file with columns t (s), y1, y2, ... and, if the system has inputs,
    u1, u2, ... Sample times may be irregular. An empty cell or ``nan`` is a missing output, or an
    input that keeps its last value. Columns y1_std, y2_std, ... hold the standard deviation of an
    output's noise at each sample, where it is known. Other columns are ignored.

    A file without columns u uses the input that the system's class defines, if it defines one.

    Raises:
        ValueError: in one line that names the file, the row and what was expected.
    """
    path = Path(path)
    rows = _rows(path)
    if not rows:
        raise ValueError(f"log {path} is empty; expected a header and rows of numbers")
    header = [name.strip() for name in rows[0][1]]
    outputs = [f"y{i + 1}" for i in range(system.ny)]
    inputs = [f"u{i + 1}" for i in range(system.nu)]
    if type(system).input is not System.input and not set(inputs) & set(header):
        inputs = []
    missing = [name for name in ["t", *outputs, *inputs] if name not in header]
    if missing:
        raise ValueError(
            f"log {path} has no column {', '.join(missing)}; {type(system).__name__} needs "
            f"{', '.join(['t', *outputs, *inputs])}, and the header has {', '.join(header)}"
        )
    levels = [name for name in (f"{output}_std" for output in outputs) if name in header]
    read = ["t", *outputs, *inputs, *levels]
    twice = [name for name in read if header.count(name) > 1]
    if twice:
        raise ValueError(f"log {path} has column {twice[0]} twice")
    columns = {name: header.index(name) for name in read}
    table = {name: np.empty(len(rows) - 1) for name in columns}
    for i, (number, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ValueError(f"log {path}, line {number}: {len(row)} cells; expected {len(header)}")
        for name, column in columns.items():
            table[name][i] = _number(row[column], name, f"log {path}, line {number}")
    t = table["t"]
    if not len(t):
        raise ValueError(f"log {path} has a header but no rows")
    wrong = np.flatnonzero(~(np.diff(t) > 0))
    if len(wrong):
        number, later, earlier = rows[wrong[0] + 2][0], t[wrong[0] + 1], t[wrong[0]]
        raise ValueError(f"log {path}, line {number}: t={later} after {earlier}; t must increase")
    _check_gaps(system, t, [f"log {path}, line {number}" for number, _ in rows[1:]])
    y = np.stack([table[name] for name in outputs], axis=-1)[None]
    if np.isnan(y).all():
        raise ValueError(f"log {path} has no output at all: every cell of {outputs} is empty")
    for name in inputs:
        if np.isnan(table[name][0]):
            raise ValueError(
                f"log {path}, line {rows[1][0]}: {name} is empty; expected a number in the first "
                "row, as an empty input keeps its last value"
            )
        table[name] = _kept(table[name])
    u = np.stack([table[n] for n in inputs], axis=-1) if inputs else system.input(t)
    std = None
    if levels:
        unknown = np.full(len(t), np.nan)
        std = np.stack([table.get(f"{output}_std", unknown) for output in outputs], axis=-1)[None]
    numbers = np.array([number for number, _ in rows[1:]])
    model = replace(system, measured_input=bool(inputs))
    return Log(path, model, Record(t, y, u[None], prior, std), numbers)


def _check_gaps(system: System, t: np.ndarray, places: list[str]) -> None:
    """Raise ValueError, with the place of the sample after it, if the model would take too many
    steps through the longest gap between times t (num_samples,) in s."""
    if len(t) < 2 or system.own_flow:
        return
    k = int(np.argmax(np.diff(t)))
    longest = longest_step(system)
    try:
        check_steps(system, t[k], t[k + 1], float(t[k + 1] - t[k]) / longest, longest)
    except ValueError as error:
        raise ValueError(f"{places[k + 1]}: {error}") from None


def _kept(values: np.ndarray) -> np.ndarray:
    """Return the values (num_samples,) with the last number before it in place of each NaN."""
    last = np.where(np.isnan(values), 0, np.arange(len(values)))
    return values[np.maximum.accumulate(last)]


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Return the cells of each line of a CSV file that is not blank, with the line's number.

    Each line is parsed by itself, as no cell of a log extends over several lines: a quote that is
    not closed is thus found in its own line, rather than at the end of the file.

    Raises:
        ValueError: in one line that names the file and the line.
    """
    rows = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                try:
                    cells = next(csv.reader([line], strict=True))
                except csv.Error as error:
                    raise ValueError(
                        f"log {path}, line {number}: {_shown(line)} is no line of a CSV file "
                        f"({error}); expected every quote to be closed in its line"
                    ) from None
                if any(cell.strip() for cell in cells):
                    rows.append((number, cells))
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"cannot read log {path}: {error}") from None
    return rows


def _shown(text: str) -> str:
    """Return the representation of a text, of which only the beginning is shown if it is long."""
    text = text.strip()
    return repr(text if len(text) <= _SHOWN else f"{text[:_SHOWN]}...")


def _number(cell: str, name: str, where: str) -> float:
    text = cell.strip()
    missing = text == "" or text.lower() == "nan"
    if missing and name != "t":
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ValueError(f"{where}: {name}={_shown(cell)} is not a finite number")
    if name.endswith("_std") and value <= 0:
        raise ValueError(f"{where}: {name}={_shown(cell)}; expected a number above 0, or no value")
    return value
