"""The plants whose libraries have been asked for.

Compilation takes a second or two. Functions that a short script may call once (`model_step`,
`truth`) therefore never begin it. Environments and estimators, which call them often, ask for a
plant's library when they are made; from then on, all calls in the process use it for plants of that
class.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary

_asked: set[tuple[type[System], str]] = set()
_making = threading.local()


def ask(system: System, template: str) -> PlantLibrary | str:
    """Return the library of an algorithm for a plant, or the reason in one line why there is none,
    and let all functions use it from now on.

    Args:
        system: the plant.
        template: the algorithm, ``truth`` or ``model``.
    """
    _asked.add((type(system), template))
    return _made(system, template)


def asked_library(system: System, template: str) -> PlantLibrary | None:
    """Return the library of a plant if it has been asked for and exists."""
    if (type(system), template) not in _asked or getattr(_making, "now", False):
        return None
    found = _made(system, template)
    return None if isinstance(found, str) else found


def is_asked(system: System, template: str) -> bool:
    """Return whether the library of a plant has been asked for."""
    return (type(system), template) in _asked


def _made(system: System, template: str) -> PlantLibrary | str:
    # SymPy, which this imports, is needed by no process that asks for nothing.
    from pinnobs_gym.simulation.kernels.plant_library import plant_library

    # What is computed while a library is made cannot use it.
    _making.now = True
    try:
        return plant_library(system, template)
    finally:
        _making.now = False
