"""A cache for what is computed once per plant."""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from pinnobs_gym.simulation.system import System

T = TypeVar("T")

_LARGEST = 64
"""Number of results of a function that are kept."""


def cached_by_plant(function: Callable[..., T]) -> Callable[..., T]:
    """Decorate a function of a system and hashable values so that it keeps its latest results.

    Systems of one class with equal parameters share them, whatever the parameters are: numbers,
    arrays, tables. For parameters that cannot be pickled, nothing is kept.
    """
    results: dict[Any, T] = {}

    @functools.wraps(function)
    def call(system: System, *values: Any) -> T:
        try:
            content = pickle.dumps([getattr(system, f.name) for f in fields(system)])
        except Exception:  # whatever pickle raises for a lambda or an open file
            return function(system, *values)
        key = (type(system), content, values)
        if key not in results:
            if len(results) >= _LARGEST:
                del results[next(iter(results))]
            results[key] = function(system, *values)
        return results[key]

    return call
