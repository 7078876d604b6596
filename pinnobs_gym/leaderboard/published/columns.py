"""Rows of results packed by column, which is a tenth of their size before compression.

A run is the rows of one estimator in one game. Its packed form has the structure of one row. In
place of each value there is an object with one key: ``same`` for a value that all rows share,
``parts`` for an object whose values are packed in turn, ``each`` for a list with a value per row.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pinnobs_gym.scoring.metrics import DIVERGED, OPTIONAL_SCORES, SCORES
from pinnobs_gym.scoring.row_format import Row
from pinnobs_gym.scoring.rows import without_absent

DIGITS = 7
"""Significant digits of packed scores: rounding to these is within the tolerance at which two rows
count as the same, `pinnobs_gym.scoring.rows.TOLERANCE`."""
_ROUNDED = frozenset((*SCORES, *OPTIONAL_SCORES, "state_rmse", "us_per_step"))
"""The fields that are rounded; settings are not, since estimators are told apart by them."""


def packed(rows: Sequence[Row]) -> dict[str, Any]:
    """Return rows with the same fields packed by column, their scores rounded to `DIGITS`."""
    return _packed([without_absent(rounded(row)) for row in rows])


def unpacked(columns: Mapping[str, Any], count: int) -> list[Row]:
    """Return the rows of their packed form.

    Args:
        columns: the result of `packed`.
        count: number of rows.

    Raises:
        ValueError: in one line, if it is not a packed form of this number of rows.
    """
    values = _unpacked(columns, count)
    if not all(isinstance(value, dict) for value in values):
        raise ValueError("expected rows packed by column")
    return values


def rounded(row: Row) -> Row:
    """Return a row with its scores rounded to `DIGITS`.

    An error just above the limit of divergence is kept as it is: rounded to the limit, it would
    contradict that the episode diverged.
    """
    changed = {name: _rounded(row[name]) for name in _ROUNDED & row.keys()}
    if (changed["nrmse_tail"] > DIVERGED) != (row["nrmse_tail"] > DIVERGED):
        changed["nrmse_tail"] = row["nrmse_tail"]
    return row | changed


def _rounded(value: Any) -> Any:
    """Round the numbers in a value."""
    if isinstance(value, Mapping):
        return {name: _rounded(part) for name, part in value.items()}
    if not isinstance(value, float):
        return value
    return float(f"{value:.{DIGITS}g}")


def _packed(values: list[Any]) -> dict[str, Any]:
    first = values[0]
    if all(type(value) is type(first) and value == first for value in values):
        return {"same": first}
    if all(isinstance(value, dict) and value.keys() == first.keys() for value in values):
        return {"parts": {name: _packed([value[name] for value in values]) for name in first}}
    return {"each": values}


def _unpacked(column: Any, count: int) -> list[Any]:
    if not isinstance(column, Mapping) or len(column) != 1:
        raise ValueError("expected an object with one of the keys same, parts and each")
    ((kind, content),) = column.items()
    if kind == "same":
        return [content] * count
    if kind == "parts" and isinstance(content, Mapping):
        parts = [_unpacked(part, count) for part in content.values()]
        return [dict(zip(content, values, strict=True)) for values in zip(*parts, strict=True)]
    if kind == "each" and isinstance(content, list) and len(content) == count:
        return content
    raise ValueError(f"expected {count} values in a column")
