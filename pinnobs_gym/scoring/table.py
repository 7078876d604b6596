"""Scored episodes for readers: a list of rows that converts to a pandas table."""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
from typing import Any

from pinnobs_gym.scoring.rows import OPTIONAL, Row, key, load_all

_LOGGER = logging.getLogger(__name__)


class Rows(list[Row]):
    """Scored episodes, each a dict; see `pinnobs_gym.scoring.row_format.Row` for its keys."""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a line per episode and a column per key.

        An episode that is in the list twice counts once. Infinite scores are ``inf``, and scores
        that do not apply NaN. ``state_rmse`` has a column for each window and state, such as
        ``state_rmse.steady.x1``. ``options``, ``settings``, ``training``, ``versions`` and
        ``knows`` are columns of Python objects.

        Raises:
            ImportError: in one line, if pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        once: dict[tuple[Any, ...], Row] = {}
        for row in self:
            once.setdefault(key(row), _flat(row))
        table = pandas.DataFrame(list(once.values()))
        return table.astype({name: float for name in OPTIONAL if name in table})


def _flat(row: Row) -> Row:
    """Return a row with a field for each error of a state."""
    flat = {name: value for name, value in row.items() if name != "state_rmse"}
    for window, errors in row["state_rmse"].items():
        flat |= {f"state_rmse.{window}.{state}": error for state, error in errors.items()}
    return flat


def read_rows(path: Path | str) -> Rows:
    """Read the scored episodes of a rows file. An episode that is in it twice counts once.

    Args:
        path: the file, such as one written by ``evaluate(..., results=path)``; files may have been
            concatenated.

    Raises:
        ValueError: in one line, if there is no such file, a line is not a row, or two lines give
            different scores of an episode.
    """
    stored = load_all([Path(path)])
    if stored.warning:
        _LOGGER.warning(stored.warning)
    return Rows(stored.rows)
