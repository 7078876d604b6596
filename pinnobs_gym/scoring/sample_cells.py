"""The cells of a submitted table as numbers, and the samples to which its lines belong."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np

from pinnobs_gym.logs.table import number
from pinnobs_gym.scoring.episode_table import Cells, shown

_SHIFT = 1e-3
"""Largest difference of a time from that of its sample, over the sample time: that of a number
which was written with few digits."""


def match_samples(cells: Cells, seeds: range, t: np.ndarray, dt: float) -> np.ndarray:
    """Return the line of each sample of each episode, shape (episodes · num_samples,).

    Args:
        cells: a table with the columns ``episode`` and ``t``.
        seeds: of the episodes.
        t: times of the samples of each, shape (num_samples,).
        dt: time between samples.

    Raises:
        ValueError: in one line, if an episode or a sample is missing or unknown, or a time is not
            that of its sample.
    """
    lines: dict[int, list[int]] = defaultdict(list)
    for i in range(len(cells.lines)):
        seed = _parsed(cells, "episode", i, _whole, "a whole number")
        if seed not in seeds:
            raise ValueError(
                f"{cells.place(i)}: episode={seed}; the records have the episodes {seeds.start} to "
                f"{seeds.stop - 1}"
            )
        lines[seed].append(i)
    missing = [seed for seed in seeds if seed not in lines]
    if missing:
        more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
        raise ValueError(
            f"{cells.path} lacks episode {missing[0]}{more}; expected all from {seeds.start} to "
            f"{seeds.stop - 1}"
        )
    times = _column(cells, "t", math.isfinite, "a finite number")
    for seed in seeds:
        _check_times(cells, seed, lines[seed], times, t, dt)
    return np.concatenate([lines[seed] for seed in seeds])


def _check_times(
    cells: Cells, seed: int, lines: list[int], times: np.ndarray, t: np.ndarray, dt: float
) -> None:
    """Raise ValueError, in one line, unless the times of an episode's lines are those of t."""
    own, common = times[lines], min(len(lines), len(t))
    wrong = np.flatnonzero(abs(own[:common] - t[:common]) > _SHIFT * dt)
    if len(wrong):
        k = int(wrong[0])
        raise ValueError(
            f"{cells.place(lines[k])}: t={float(own[k]):.9g} is sample {k} of episode {seed}; "
            f"expected t={float(t[k]):.9g}, the times of the records in their order"
        )
    if len(own) < len(t):
        raise ValueError(
            f"{cells.path}: episode {seed} ends after {len(own)} samples; expected {len(t)}, the "
            f"next of t={float(t[len(own)]):.9g}"
        )
    if len(own) > len(t):
        raise ValueError(
            f"{cells.place(lines[len(t)])}: t={float(own[len(t)]):.9g} comes after the last sample "
            f"of episode {seed}; expected {len(t)} samples, to t={float(t[-1]):.9g}"
        )


def finite_or_lost(cells: Cells, name: str) -> np.ndarray:
    """Return a column of estimates, infinite where these have diverged, as an array (lines,).

    Raises:
        ValueError: in one line, if a cell is empty, NaN or not a number.
    """
    expected = "a number, or inf where the estimate has diverged"
    return _column(cells, name, lambda value: not math.isnan(value), expected)


def not_negative(cells: Cells, name: str) -> np.ndarray:
    """Return a column of standard deviations as an array (lines,).

    Raises:
        ValueError: in one line, if a cell is not a number of at least 0.
    """
    return _column(cells, name, lambda value: value >= 0, "a number of at least 0")


def _column(cells: Cells, name: str, fits: Callable[[float], bool], expected: str) -> np.ndarray:
    """Return a column as numbers; ``fits`` tells whether a number is allowed."""

    def number(cell: Any) -> float:
        value = _float(cell)
        if not fits(value):
            raise ValueError
        return value

    count = len(cells.columns[name])
    return np.array([_parsed(cells, name, i, number, expected) for i in range(count)])


def _parsed(cells: Cells, name: str, i: int, parse: Callable[[Any], Any], expected: str) -> Any:
    """Return a cell as ``parse`` converts it.

    Raises:
        ValueError: in one line that names the line, the column and the cell, if it cannot.
    """
    cell = cells.columns[name][i]
    try:
        return parse(cell)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{cells.place(i)}: {name}={shown(cell)}; expected {expected}") from None


def _float(cell: Any) -> float:
    """Return the number of a cell: of a CSV file a text, which may be ``inf``."""
    if not isinstance(cell, str):
        return float(cell)
    text = cell.strip()
    value = number(text)
    if math.isinf(value) and text.lower().lstrip("+-") != "inf":  # 1e400 has not diverged
        raise ValueError
    return value


def _whole(cell: Any) -> int:
    """Return a whole number, which may be written as ``3.0`` or ``3e+00``."""
    value = _float(cell)
    if value != int(value):
        raise ValueError
    return int(value)
