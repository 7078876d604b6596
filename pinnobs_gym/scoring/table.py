"""Scored episodes for readers: a list of rows that converts to a pandas table."""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
from typing import Any

from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES
from pinnobs_gym.scoring.rows import Row, key, load_all

_LOGGER = logging.getLogger(__name__)


class Rows(list[Row]):
    """Scored episodes, each a dict; see `pinnobs_gym.scoring.rows.Row` for its keys."""

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with a line per episode and a column per key.

        An episode that is in the list twice counts once. Infinite scores are ``inf``, and scores
        that do not apply NaN. ``options``, ``training``, ``versions`` and ``knows`` are columns of
        Python objects.

        Raises:
            ImportError: in one line, if pandas is not installed.
        """
        try:
            pandas = importlib.import_module("pandas")
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        once: dict[tuple[Any, ...], Row] = {}
        for row in self:
            once.setdefault(key(row), row)
        table = pandas.DataFrame(list(once.values()))
        return table.astype({name: float for name in OPTIONAL_SCORES if name in table})


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
