"""The sample times of a log: numbers, or dates and times by ISO 8601, and their checks."""

from __future__ import annotations

import math
import re
from datetime import datetime

import numpy as np

from pinnobs_gym.logs.csv_lines import shown
from pinnobs_gym.logs.formulas import Formula
from pinnobs_gym.logs.table import Table, number, quoted
from pinnobs_gym.simulation.motion import check_steps
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System

_LONGEST_GAP = 1e8
"""Length of a gap in s (three years) that is taken for a jump of the clock, whatever the plant."""
_STEPS_IN_GAP = 1000
"""Number of usual steps in a gap, at least, that is taken for such a jump."""
_FACTOR = 3
"""Factor by which a median step may differ from the setup's ``dt`` in another unit, a power of a
thousand smaller or larger, to be taken for a wrong unit."""
_FEWEST = 2
"""Number of steps from which on the unit of the times is judged."""
_FRACTION = re.compile(r"(.*\d\d:?\d\d:?\d\d)[.,](\d+)(.*)")
_ROUNDING = 1e-9
"""Largest distance from a whole number, relative to it, that counts as rounding."""


def read_times(table: Table, formula: Formula) -> tuple[np.ndarray, datetime | None]:
    """Return the times (num_samples,) of a log in s, and the instant of the first sample if they
    are dates and times, in s since then.

    Raises:
        ValueError: in one line with the first row that has no time, or one of another kind.
    """
    columns, start = {}, None
    for name in formula.columns:
        cells = table.cells(name)
        if _is_number(cells[0]):
            columns[name] = table.numbers(name)
            blank = np.flatnonzero(np.isnan(columns[name]))
            if len(blank):
                cell = shown(cells[blank[0]])
                raise ValueError(
                    f"{table.place(blank[0])}: {name}={cell} is not a finite number, as every "
                    "time has to be"
                )
        else:
            columns[name], start = _seconds(table, name, cells)
    t = formula.values(columns, len(table.rows))
    wrong = np.flatnonzero(~np.isfinite(t))
    if len(wrong):
        k = wrong[0]
        raise ValueError(f"{table.place(k)}: t={formula.text} is {t[k]}; expected a finite number")
    return t, start


def _is_number(cell: str) -> bool:
    try:
        number(cell.replace(",", ".") or "nan")
    except ValueError:
        return False
    return True


def _seconds(table: Table, name: str, cells: list[str]) -> tuple[np.ndarray, datetime]:
    """Return the seconds (num_samples,) since the first of some instants, and that."""
    whole, fractions = [], []
    for row, cell in enumerate(cells):
        place = f"{table.place(row)}: {name}={shown(cell)}"
        match = _FRACTION.fullmatch(cell)  # of more digits than a datetime holds
        text, digits = (match[1] + match[3], match[2]) if match else (cell, "0")
        try:
            whole.append(datetime.fromisoformat(text))
        except ValueError:
            either = "" if row else "neither a finite number nor "
            raise ValueError(
                f"{place} is {either or 'not '}a date and time by ISO 8601, such as "
                "2026-03-01T12:00:00.250Z"
            ) from None
        if (whole[row].tzinfo is None) != (whole[0].tzinfo is None):
            has = "no" if whole[row].tzinfo is None else "an"
            raise ValueError(
                f"{place} has {has} offset from UTC, unlike the rows before; expected all times "
                "with one, or all without"
            )
        fractions.append(float(f"0.{digits}"))
    part = np.array(fractions)
    seconds = np.array([(instant - whole[0]).total_seconds() for instant in whole])
    start = whole[0].replace(microsecond=min(999_999, round(part[0] * 1e6)))
    return seconds + (part - part[0]), start


def instant(t: float, times: np.ndarray) -> str:
    """Return one of the times (num_samples,) of a log with six digits, or with as many more as tell
    it from its neighbours."""
    step, digits = float(np.median(np.diff(times))) if len(times) > 1 else 0.0, 6
    if t and step > 0:
        digits = max(6, min(15, 2 + math.floor(math.log10(abs(t))) - math.floor(math.log10(step))))
    return f"{t:.{digits}g}"


def without_rounding(t: np.ndarray) -> np.ndarray:
    """Return times (num_samples,) in steps of a map, of which those that are whole numbers but for
    the rounding of a formula, such as 0.3/0.1, are whole."""
    whole = np.round(t)
    return np.where(abs(t - whole) <= _ROUNDING * np.maximum(abs(whole), 1), whole, t)


def check_times(system: System, table: Table, t: np.ndarray, formula: Formula | None) -> None:
    """Check that times increase, are in the model's unit, and have no gap that is a jump of the
    clock, or through which the model would take too many steps.

    Args:
        system: the model.
        table: the log, for the lines of messages.
        t: the times (num_samples,).
        formula: the times' formula, whose unit is judged; None if the user insists on it.

    Raises:
        ValueError: in one line that names the file, and where there is one the line.
    """
    wrong = np.flatnonzero(~(np.diff(t) > 0))
    if len(wrong):
        k = wrong[0]
        raise ValueError(f"{table.place(k + 1)}: t={t[k + 1]} after {t[k]}; t must increase")
    if formula is not None:
        _check_unit(system, table, t, formula)
    if len(t) > 1:
        _check_gaps(system, table, t)
    if system.discrete and (t != np.round(t)).any():
        k = np.flatnonzero(t != np.round(t))[0]
        kind = type(system).__name__
        raise ValueError(
            f"{table.place(k)}: t={t[k]}; {kind} is a map, whose times count steps; expected a "
            "whole number"
        )


def _check_unit(system: System, table: Table, t: np.ndarray, formula: Formula) -> None:
    """Raise ValueError if the times seem to be in another unit than the model's, such as ms."""
    if len(t) <= _FEWEST:
        return
    step, dt = float(np.median(np.diff(t))), system.setups["benchmark"].dt
    ratio = step / dt
    power = round(np.log10(ratio) / 3)
    near = abs(np.log10(ratio) - 3 * power) <= np.log10(_FACTOR)
    # Any step that is far too long is told: the model takes very many of its own through it.
    if not (ratio * _FACTOR >= 1000 or (power < 0 and near)):
        return
    unit = "" if system.discrete else " s"
    own = formula.text.strip()
    same = quoted("t=t" if own == "t" else f"t={own}*1")
    factor = f"/1e{3 * power}" if system.discrete and power > 0 else f"*1e{-3 * power}"
    other = quoted(f"t={own}{factor}")
    raise ValueError(
        f"log {table.path}: t grows by {step:.6g}{unit} from sample to sample (median), "
        f"{ratio:.4g} times the dt={dt:g}{unit} of {type(system).__name__}, as if it were in "
        f"another unit; give --columns {other}, or {same} if it is right"
    )


def _check_gaps(system: System, table: Table, t: np.ndarray) -> None:
    """Raise ValueError, with the line after it, if the longest gap is that of a clock that jumps,
    or if the model would take too many steps through it."""
    steps = np.diff(t)
    k = int(np.argmax(steps))
    gap, usual = float(steps[k]), max(float(np.median(steps)), system.setups["benchmark"].dt)
    if not system.own_flow:
        longest = longest_step(system)
        try:
            check_steps(system, t[k], t[k + 1], gap / longest, longest)
        except ValueError as error:
            raise ValueError(f"{table.place(k + 1)}: {error}") from None
    if gap >= _LONGEST_GAP and gap > _STEPS_IN_GAP * usual:
        unit = "" if system.discrete else " s"
        raise ValueError(
            f"{table.place(k + 1)}: t={t[k + 1]:.15g}{unit} after {t[k]:.15g}{unit}, as if the "
            "clock jumped; expected all times of one clock and in the unit of the model"
        )
