"""Tables by columns, as charts need them, and statistics of columns."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

Columns: TypeAlias = dict[str, list[Any]]
"""A table by columns; None marks a gap."""
QUANTILES = (0.1, 0.25, 0.75, 0.9)
"""Probabilities of the quantiles shown besides the median."""


def extend(table: Columns, **new: list[Any]) -> None:
    """Append to the columns of a table."""
    for name, values in new.items():
        table[name] += values


def numbers(values: np.ndarray) -> list[float | None]:
    """Apply `number` to each value."""
    return [number(value) for value in np.asarray(values, dtype=float).tolist()]


def number(value: float) -> float | None:
    """Round to four significant digits; None for values that are not finite."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def medians(values: np.ndarray) -> np.ndarray:
    """Return the medians of columns, shape (columns,), of values (rows, columns). NaN is ignored,
    infinite values count."""
    ordered, count = _sorted(values)
    middle = np.stack([(count - 1) // 2, count // 2])
    return np.take_along_axis(ordered, middle, axis=0).mean(axis=0)


def quantiles(values: np.ndarray) -> np.ndarray:
    """Return the `QUANTILES` of columns, shape (quantiles, columns), each an element of the column.
    NaN is ignored, infinite values count."""
    ordered, count = _sorted(values)
    places = np.ceil(np.multiply.outer(QUANTILES, count) - 1e-9).astype(int) - 1
    return np.take_along_axis(ordered, np.maximum(places, 0), axis=0)


def _sorted(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sort columns in ascending order with NaN last; also return how many values of each are not
    NaN."""
    return np.sort(values, axis=0), (~np.isnan(values)).sum(axis=0)
