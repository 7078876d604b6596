"""The provenance of a score: settings, versions and date."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

import numpy as np

from pinnobs_gym.simulation.system import System


def canonical(value: Any) -> Any:
    """Convert a value to JSON's types, equal values to equal results. Objects other than data are
    converted to the name of their class or function."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return canonical(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): canonical(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [canonical(part) for part in value]
    if isinstance(value, System):
        return {"system": type(value).__name__, **canonical(value.parameters)}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: canonical(getattr(value, f.name)) for f in fields(value) if f.repr}
    if isinstance(value, np.generic):
        return value.item()
    return getattr(value, "__qualname__", type(value).__qualname__)


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a score depends on."""
    packages = ("pinnobs-gym", "numpy", "scipy", "torch", "gymnasium")
    installed = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), **installed}


def now() -> str:
    """Return the date and time (UTC) in the format of rows."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")
