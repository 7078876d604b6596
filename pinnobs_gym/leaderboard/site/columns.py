"""Tables by columns, as charts take them, and statistics of columns of scores."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np

Columns: TypeAlias = dict[str, list[Any]]
"""A table by columns; None is a gap."""
QUANTILES = (0.1, 0.25, 0.75, 0.9)
"""Those that charts show besides the median."""


def extend(table: Columns, **new: list[Any]) -> None:
    """Add to the columns of a table."""
    for name, values in new.items():
        table[name] += values


def numbers(values: np.ndarray) -> list[float | None]:
    """Each as `number` gives it."""
    return [number(value) for value in np.asarray(values, dtype=float).tolist()]


def number(value: float) -> float | None:
    """Four significant digits; what is not finite is a gap."""
    return float(f"{value:.4g}") if np.isfinite(value) else None


def medians(values: np.ndarray) -> np.ndarray:
    """Medians of columns, shape (columns,) of values (rows, columns); what is not a number is left
    out, infinite values count."""
    ordered, count = _sorted(values)
    middle = np.stack([(count - 1) // 2, count // 2])
    return np.take_along_axis(ordered, middle, axis=0).mean(axis=0)


def quantiles(values: np.ndarray) -> np.ndarray:
    """`QUANTILES` of columns, shape (quantiles, columns), each a value that occurs; what is not a
    number is left out, infinite values count."""
    ordered, count = _sorted(values)
    places = np.ceil(np.multiply.outer(QUANTILES, count) - 1e-9).astype(int) - 1
    return np.take_along_axis(ordered, np.maximum(places, 0), axis=0)


def _sorted(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns in ascending order, and how many of each are numbers; these come first."""
    return np.sort(values, axis=0), (~np.isnan(values)).sum(axis=0)
