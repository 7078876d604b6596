"""The plants whose libraries have been asked for.

Compilation takes a second or two. Functions that a short script may call once (`model_step`,
`truth`) therefore never begin it. Environments and estimators, which call them often, ask for a
plant's library when they are made; from then on, all calls in the process use it for plants of that
class.
"""

from __future__ import annotations

import os
import threading
from typing import TYPE_CHECKING, Any

from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary

_asked: set[tuple[type[System], str]] = set()
_making = threading.local()


class _Answer:
    """A library or the reason why there is none, kept with a plant. The plant's copies and pickles
    are without it, since a library's addresses hold in one process only."""

    def __init__(self, found: PlantLibrary | str) -> None:
        self.found = found

    def __reduce__(self) -> Any:
        return _nothing, ()


def _nothing() -> None:
    return None


def ask(system: System, template: str) -> PlantLibrary | str:
    """Return the library of an algorithm for a plant, or the reason in one line why there is none,
    and let all functions use it from now on for plants of that class.

    Args:
        system: the plant.
        template: the algorithm, ``truth`` or ``model``.
    """
    found = _found(system, template)
    if not isinstance(found, str):
        _asked.add((type(system), template))
    return found


def is_asked(system: System, template: str) -> bool:
    """Return whether the library of plants of that class has been asked for, and may be used."""
    asked = (type(system), template) in _asked
    return asked and os.environ.get("PINNOBS_KERNELS") != "0"


def asked_library(system: System, template: str) -> PlantLibrary | None:
    """Return the library of a plant if it has been asked for and exists."""
    if not is_asked(system, template) or getattr(_making, "now", False):
        return None
    found = _found(system, template)
    return None if isinstance(found, str) else found


def _found(system: System, template: str) -> PlantLibrary | str:
    """Return what `plant_library` does; it is kept with the plant."""
    if os.environ.get("PINNOBS_KERNELS") == "0":
        return "kernels are turned off by PINNOBS_KERNELS=0"
    key = f"_library_{template}"
    kept: _Answer | None = vars(system).get(key)
    if kept is not None:
        return kept.found
    # SymPy, which this imports, is needed by no process that asks for nothing.
    from pinnobs_gym.simulation.kernels.plant_library import plant_library

    # What is computed while a library is made cannot use it.
    before, _making.now = getattr(_making, "now", False), True
    try:
        found = plant_library(system, template)
    finally:
        _making.now = before
    vars(system)[key] = _Answer(found)
    return found
