"""The reading of sensor logs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from pinnobs_gym.logs.columns import chosen, unused
from pinnobs_gym.logs.csv_lines import shown
from pinnobs_gym.logs.formulas import Formula
from pinnobs_gym.logs.table import Table, listed, read_table
from pinnobs_gym.logs.times import check_times, read_times, without_rounding
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import LARGEST


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
    """The instant of the first sample, if the file has dates and times; None if it has numbers."""


def read_log(path: str | Path, system: System, prior: Prior, columns: Sequence[str] = ()) -> Log:
    """Read a log from a CSV file with a header.

    Its columns are t (s, or steps of a map), the outputs as y1, y2, ... or by their own names, and,
    if the system has inputs, these as u1, u2, ... or by their own names. Sample times may be
    irregular. An empty cell or ``nan`` is a missing output, or an input that keeps its last value.
    Numbers are in digits from 0 to 9; those above 1e30 are none that a sensor measured.
    Columns y1_std or ``<output>_std`` hold the standard deviation of an output's noise at each
    sample, where it is known. Other columns are not used, which a note says.

    Times may be dates and times by ISO 8601, all with an offset from UTC or all without. They are
    read as seconds since the first sample, with `Log.start` the instant of that.

    A file without columns of inputs uses the input that the system's class defines, if it defines
    one. Cells may be separated by semicolons or tabs, too, then also with decimal commas.

    Args:
        path: the file.
        system: the model.
        prior: the prior of the record.
        columns: columns under other names or in other units, as ``target=formula``: such as
            ``t=millis*1e-3``, ``y1=voltage`` or ``t={Time (s)}``; see
            `pinnobs_gym.logs.formulas.Formula` and `pinnobs_gym.logs.columns.chosen`.

    Raises:
        ValueError: in one line that names the file, the line and what was expected; also if times
            seem to be in another unit than the model's.
    """
    table = read_table(Path(path))
    formulas = chosen(system, table, columns)
    t, start = read_times(table, formulas["t"])
    t = without_rounding(t) if system.discrete else t
    insisted = _insisted(formulas["t"], columns)
    check_times(system, table, t, None if insisted else formulas["t"])
    values = {name: _values(table, name, f) for name, f in formulas.items() if name != "t"}
    outputs = [values[f"y{i + 1}"] for i in range(system.ny)]
    y = np.stack(outputs, axis=-1)[None]
    if np.isnan(y).all():
        names = listed([formulas[f"y{i + 1}"].text for i in range(system.ny)])
        raise ValueError(f"log {path} has no output at all: every cell of {names} is empty")
    measured = "u1" in values
    u = _inputs(system, table, values) if measured else system.input(t)
    std = None
    if any(name.endswith("_std") for name in values):
        unknown = np.full(len(t), np.nan)
        levels = [values.get(f"y{i + 1}_std", unknown) for i in range(system.ny)]
        std = np.stack(levels, axis=-1)[None]
    return Log(
        table.path,
        replace(system, measured_input=measured),
        Record(t, y, np.asarray(u)[None], prior, std),
        table.lines,
        _notes(table, formulas, t, start),
        start,
    )


def _insisted(formula: Formula, columns: Sequence[str]) -> bool:
    """Return whether the times' unit is as the user says: by arithmetic, or by ``t=t``."""
    given = any(each.partition("=")[0].strip() == "t" for each in columns)
    return given and (not formula.plain or formula.columns == ("t",))


def _values(table: Table, quantity: str, formula: Formula) -> np.ndarray:
    """Return the values (num_samples,) of a quantity, NaN where a cell in its formula is empty."""
    columns = {name: table.numbers(name) for name in formula.columns}
    found = formula.values(columns, len(table.rows))
    wrong = ~(abs(found) <= LARGEST)
    for values in columns.values():
        wrong &= ~np.isnan(values)
    expected = f"a finite number up to {LARGEST:g}"
    if quantity.endswith("_std"):
        wrong |= found <= 0
        expected = "a number above 0, or no value"
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        value = f"{found[k]:g}, from {shown(formula.text)}"
        if formula.plain:
            quantity = formula.columns[0]
            value = shown(table.cells(quantity)[k])
        raise ValueError(f"{table.place(k)}: {quantity}={value}; expected {expected}")
    return found


def _inputs(system: System, table: Table, values: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the inputs (num_samples, nu), with the last number before it in place of each NaN."""
    columns = []
    for i in range(system.nu):
        u = values[f"u{i + 1}"]
        if np.isnan(u[0]):
            raise ValueError(
                f"{table.place(0)}: u{i + 1} is empty; expected a number in the first row, as an "
                "empty input keeps its last value"
            )
        last = np.where(np.isnan(u), 0, np.arange(len(u)))
        columns.append(u[np.maximum.accumulate(last)])
    return np.stack(columns, axis=-1)


def _notes(
    table: Table, formulas: Mapping[str, Formula], t: np.ndarray, start: datetime | None
) -> tuple[str, ...]:
    """Return what the user is to know of a log that was read."""
    notes = []
    if start is not None:
        notes.append(f"log {table.path}: t = {t[0]:g} is {start.isoformat()}")
    used = {name: None for formula in formulas.values() for name in formula.columns}
    commas = [name for name in used if table.decimal_commas(name)]
    if commas:
        notes.append(f"log {table.path}: commas in numbers are read as decimal points")
    if left := unused(table, formulas.values()):
        notes.append(f"log {table.path}: columns that are not used: {listed(left)}")
    return tuple(notes)
