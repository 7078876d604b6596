"""Lines in the log about what an estimator had to do on its own, each said once."""

from __future__ import annotations

import logging
from functools import lru_cache

_LOGGER = logging.getLogger(__name__)


@lru_cache(maxsize=1000)
def say_once(line: str) -> None:
    """Log a warning the first time that this process says this line."""
    _LOGGER.warning(line)
