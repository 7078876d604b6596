"""Plants as people have them, and what the classical estimators reach on them."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from benchmarks import Figure


def figures(repeats: int) -> Iterator[Figure]:
    """Measure what the estimators reach on the plants of each module; seeds are fixed."""
    for module in sorted(each.name for each in pkgutil.iter_modules(__path__)):
        yield from importlib.import_module(f"{__name__}.{module}").figures(repeats)
