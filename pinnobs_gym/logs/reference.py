"""Reference states of a sensor log, such as a motion capture's, with which estimates are compared.

A reference has times of its own. Those between two samples of the log become rows of the record
without outputs, so that nothing is interpolated: an estimate there is the estimator's own.
"""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

import numpy as np

from pinnobs_gym.logs.formulas import Formula
from pinnobs_gym.logs.reading import Log
from pinnobs_gym.logs.table import Table, listed, read_table
from pinnobs_gym.logs.times import read_times
from pinnobs_gym.simulation.motion import Interval
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

_SAME = 1e-6
"""Largest difference of a time from that of a sample, over the median step of the log, with which
both are the same: that of a number written with few digits."""


@dataclass(frozen=True)
class ReferencedLog:
    """A sensor log with reference states, as an episode of one row."""

    log: Log
    """The log."""
    reference: Path
    """The file of the reference."""
    record: Record
    """The samples of the log and, as rows without outputs, the times of the reference between."""
    truth: np.ndarray
    """Reference states at the rows of the record, shape (1, num_samples, nx), in state units; NaN
    where there is none."""
    own: np.ndarray
    """Which rows of the record are samples of the log, bool (num_samples,)."""
    notes: tuple[str, ...] = ()
    """What the user should know, a line each."""


def read_reference(path: str | Path, log: Log) -> ReferencedLog:
    """Read the reference states of a log from a CSV file with columns t and some of the states by
    name, in state units. An empty cell is a state that is not known at that time. Other columns are
    named in a note. Rows at times outside the log are left out, with a note.

    Times are those of the log: in its unit, or dates and times if the log has these.

    Raises:
        ValueError: in one line that names the file, the row and what was expected, if there is no
            column of a state, a cell is not a number, times do not increase, are of another kind
            than the log's or no whole numbers for a map, or no state is known at any time of the
            log.
    """
    table, system = read_table(Path(path), "reference"), log.system
    states = [name for name in system.state_names if name in table.header]
    _check_names(table, system, states)
    measured = [name for name in states if name in system.output_names]
    if measured and table.path.resolve() == log.path.resolve():
        raise ValueError(
            f"reference {path} is the log itself, whose {listed(measured)} are outputs; expected "
            "states from elsewhere"
        )
    t = _times(table, log)
    x = np.full((len(t), system.nx), np.nan)
    for name in states:
        x[:, system.state_names.index(name)] = table.numbers(name)
    notes = []
    if unused := [name for name in table.header if name not in ("t", *states)]:
        notes.append(f"reference {path}: columns that are not used: {listed(unused)}")
    given = ~np.isnan(x).all(axis=1)
    t, x = t[given], x[given]
    if not len(t):
        raise ValueError(f"reference {path} has no number in its columns {', '.join(states)}")
    within, index = _placed(t, log.record.t)
    if not within.any():
        first, last = log.record.t[[0, -1]]
        raise ValueError(
            f"reference {path} has times from {t[0]:g} to {t[-1]:g}; log {log.path} goes from "
            f"{first:g} to {last:g}, expected some times in common"
        )
    if outside := int((~within).sum()):
        notes.append(
            f"reference {path}: {outside} of {len(t)} rows are at times outside log {log.path}, "
            "and left out"
        )
    return _joined(log, table.path, t[within], x[within], index[within], tuple(notes))


def _times(table: Table, log: Log) -> np.ndarray:
    """Return the times (num_rows,) of a reference, in s or steps, on the clock of its log.

    Raises:
        ValueError: in one line that names the file and the line.
    """
    t, start = read_times(table, Formula.column("t"))
    if (start is None) != (log.start is None):
        kinds = ["dates and times" if each else "numbers" for each in (start, log.start)]
        raise ValueError(
            f"reference {table.path} has {kinds[0]} in column t; expected {kinds[1]}, as log "
            f"{log.path} has"
        )
    if start is not None and log.start is not None:
        if (start.tzinfo is None) != (log.start.tzinfo is None):
            raise ValueError(
                f"reference {table.path} and log {log.path}: the times of one alone have an offset "
                "from UTC; expected both, or neither"
            )
        t = t + (start - log.start).total_seconds()
    wrong = np.flatnonzero(~(np.diff(t) > 0))
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(f"{table.place(k + 1)}: t={t[k + 1]} after {t[k]}; t must increase")
    if log.system.discrete and (t != np.round(t)).any():
        k = int(np.flatnonzero(t != np.round(t))[0])
        kind = type(log.system).__name__
        raise ValueError(f"{table.place(k)}: t={t[k]:g}; {kind} is a map, expected a whole number")
    return t


def _check_names(table: Table, system: System, states: list[str]) -> None:
    """Check the names of the columns: t, and at least one state.

    Raises:
        ValueError: in one line, with the state that an unknown name may stand for.
    """
    expected = f"t and some of {', '.join(system.state_names)}, the states of"
    expected += f" {type(system).__name__}"
    if "t" not in table.header:
        raise ValueError(f"reference {table.path} has no column t; expected {expected}")
    left = {name.lower(): name for name in system.state_names if name not in states}
    for name in table.header:
        near = get_close_matches(name.lower(), left, 1, 0.8)
        if name != "t" and name not in states and near:
            raise ValueError(
                f"reference {table.path} has a column {name!r} (did you mean {left[near[0]]!r}?); "
                f"expected {expected}"
            )
    if not states:
        raise ValueError(
            f"reference {table.path} has the columns {listed(table.header)}; expected {expected}"
        )


def _placed(t: np.ndarray, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which times t (n,) of a reference are within those of the samples, and the sample that
    each is the same as, −1 between them."""
    tolerance = _SAME * float(np.median(np.diff(samples))) if len(samples) > 1 else 0.0
    right = np.clip(np.searchsorted(samples, t), 1, max(len(samples) - 1, 1))
    choices = np.stack([right - 1, np.minimum(right, len(samples) - 1)])
    distance = abs(samples[choices] - t)
    nearest = choices[distance.argmin(axis=0), np.arange(len(t))]
    index = np.where(distance.min(axis=0) <= tolerance, nearest, -1)
    within = (index >= 0) | ((t > samples[0]) & (t < samples[-1]))
    return within, index


def _joined(
    log: Log, path: Path, t: np.ndarray, x: np.ndarray, index: np.ndarray, notes: tuple[str, ...]
) -> ReferencedLog:
    """Return a log with the rows of a reference: times t (n,), states x (n, nx), and the sample of
    the log that each is at, −1 between samples."""
    record, between = log.record, index < 0
    if len(np.unique(index[~between])) < (~between).sum():
        raise ValueError(f"reference {path} has two rows at the same sample of log {log.path}")
    times = np.concatenate([record.t, t[between]])
    order = np.argsort(times, kind="stable")
    place = np.argsort(order)  # the row of each
    own = order < record.num_samples
    truth = np.full((1, len(times), x.shape[1]), np.nan)
    truth[0, place[index[~between]]] = x[~between]
    truth[0, place[record.num_samples :]] = x[between]

    def with_blanks(values: np.ndarray) -> np.ndarray:
        blank = np.full((1, len(times), values.shape[2]), np.nan)
        blank[:, own] = values
        return blank

    u = with_blanks(record.u)
    u[0, ~own] = _inputs(log, t[between])
    std = None if record.noise_std is None else with_blanks(record.noise_std)
    whole = Record(times[order], with_blanks(record.y), u, record.prior, std)
    return ReferencedLog(log, path, whole, truth, own, notes)


def _inputs(log: Log, t: np.ndarray) -> np.ndarray:
    """Return the inputs (n, nu) at times t (n,) between the samples of a log, which move the model
    there as those of the samples alone do."""
    system, samples, u = log.system, log.record.t, log.record.u[0]
    found = np.empty((len(t), u.shape[1]))
    for i, (now, k) in enumerate(zip(t, np.searchsorted(samples, t), strict=True)):
        over = Interval(system, samples[k - 1], samples[k], u[k - 1], u[k])
        found[i] = over.input(np.asarray(now))
    return found
