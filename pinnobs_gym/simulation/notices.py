"""Lines in the log about what was done otherwise than asked, each said once."""

from __future__ import annotations

import logging
from functools import lru_cache

_LOGGER = logging.getLogger(__name__)


@lru_cache(maxsize=1000)
def say_once(line: str) -> None:
    """Log a warning the first time that this process says this line."""
    _LOGGER.warning(line)


_SUBJECTS: set[str] = set()
"""What `say_first` was called about."""


def say_first(subject: str, line: str) -> None:
    """Log a warning the first time that this process says anything about a subject."""
    if subject not in _SUBJECTS:
        _SUBJECTS.add(subject)
        _LOGGER.warning(line)
