"""The libraries of compiled algorithms of a plant.

An index in the cache folder tells the library of a plant whose code is known (`plant_key`), so that
most processes need not trace it, which would import SymPy. Whatever the index says, a library is
used only after its functions gave the values of the plant's own (`agreement`).
"""

from __future__ import annotations

import ctypes
import os
import warnings
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.kernels.agreement import agrees
from pinnobs_gym.simulation.kernels.build import kept, library, usable_compilers, without_compiler
from pinnobs_gym.simulation.kernels.cache_folder import PLANT, kernel_folder, read_json, write_json
from pinnobs_gym.simulation.kernels.compilers import tools
from pinnobs_gym.simulation.kernels.plant_key import plant_key
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.plant_form import PlantForm, cached_by_form, plant_form
from pinnobs_gym.simulation.system import System

LARGEST = 12
"""Largest number of states of a plant that is compiled; beyond it BLAS takes less time."""
MOST_OUTPUTS = 32
"""Largest number of its outputs. Matrices of all outputs and lanes are on the stack, of which a
thread may have half a megabyte."""
MOST_FORMS = 8
"""Number of forms of a class that a process compiles. Systems that differ in more than numbers, or
whose equations branch on numbers, each need code of their own."""
OFF = "kernels are turned off by PINNOBS_KERNELS=0"
_UNTRACED = "its equations cannot be traced"
_OTHER = "its compiled equations give other values"


@dataclass(frozen=True, eq=False)
class PlantLibrary:
    """Compiled algorithms for the equations of a plant."""

    code: ctypes.CDLL
    numbers: tuple[str, ...]
    """The attributes of the system that the code takes as numbers, in their order."""


def plant_library(system: System, template: str) -> PlantLibrary | str:
    """Return the library of an algorithm for a plant, or the reason in one line why there is none.

    Systems of one class that differ in numbers only share it. If the equations could have been
    compiled but for what they call or branch on, the log says so once; what a plant is, such as
    stiff, is no fault.

    Args:
        system: the plant; its parameters may be arrays (batch,) of one number per row.
        template: the algorithm, such as ``ekf``.
    """
    reason = _excluded(system)
    if reason:
        return reason
    found = _library(system, template)
    if isinstance(found, str) and found.startswith((_UNTRACED, _OTHER)):
        say_once(f"{type(system).__name__} is computed in NumPy, which takes longer: {found}")
    return found


def why_not(system: System, template: str) -> str:
    """Return why an algorithm is not compiled for a plant, an empty text if it is or would be. The
    plant is traced if need be, but nothing is compiled."""
    reason = _excluded(system)
    if reason or usable_compilers():
        return reason or _why_untraced(system, template)
    return without_compiler()


def _excluded(system: System) -> str:
    """Return what about a plant keeps it from being compiled, an empty text if nothing does."""
    if os.environ.get("PINNOBS_KERNELS") == "0":
        return OFF
    if system.own_flow:
        return "it moves by a flow of its own"
    if system.stiff:
        return "it is stiff"
    if system.nx > LARGEST:
        return f"it has {system.nx} states, more than {LARGEST}"
    if system.ny > MOST_OUTPUTS:
        return f"it has {system.ny} outputs, more than {MOST_OUTPUTS}"
    for name in ("output_residual", "state_residual"):
        if getattr(type(system), name) is not getattr(System, name):
            return f"it defines {name}"
    return ""


@cached_by_plant
def _library(system: System, template: str) -> PlantLibrary | str:
    """Return the library for this system's own numbers, or the reason why there is none."""
    first = _of_system(system, template, False)
    if not isinstance(first, str) or not first.startswith((_UNTRACED, _OTHER)):
        return first
    # The equations may branch on numbers: then these are written into the code.
    second = _of_system(system, template, True)
    return first if isinstance(second, str) else second


def _of_system(system: System, template: str, literal: bool) -> PlantLibrary | str:
    try:
        found = _of_form(plant_form(system, literal), template)
        if isinstance(found, str) or agrees(system, found.code, found.numbers):
            return found
    except Exception as error:  # whatever the user's functions raise
        return f"{_UNTRACED}: {_line(error)}"
    return _OTHER


_forms: Counter[tuple[type[System], str]] = Counter()
"""Number of forms of each class that were traced for each algorithm."""


@cached_by_form
def _of_form(form: PlantForm, template: str) -> PlantLibrary | str:
    """Return the library of a form, whose functions are not compared yet, or a reason."""
    cls = type(form.system)
    candidates = usable_compilers()
    entry = _entry(form, template) if candidates else None
    told = None if entry is None else read_json(entry)
    if isinstance(told, dict):
        if "reason" in told:
            return told["reason"]
        code = kept(told["library"])
        if code is not None:
            return PlantLibrary(code, tuple(told["numbers"]))
    if not candidates:
        say_once(f"{without_compiler()}; estimators run in NumPy, which takes longer")
        return without_compiler()
    _forms[cls, template] += 1
    if _forms[cls, template] > MOST_FORMS:
        return f"more than {MOST_FORMS} {cls.__name__} differ in other things than numbers"
    traced = _traced(form, template)
    if isinstance(traced, str):
        _write(entry, {"reason": traced})
        return traced
    source, numbers = traced
    made = library(source, {"plant": cls.__name__, "template": template})
    if isinstance(made, str):
        return made
    code, name = made
    _write(entry, {"library": name, "numbers": numbers})
    return PlantLibrary(code, numbers)


def _traced(form: PlantForm, template: str) -> tuple[str, tuple[str, ...]] | str:
    """Return the source of a library and the numbers that it takes, or why there is none."""
    from pinnobs_gym.simulation.kernels.plant_code import plant_code
    from pinnobs_gym.simulation.kernels.source import library_source

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            plant = plant_code(form)
    except Exception as error:  # whatever the user's functions raise when they are given symbols
        return f"{_UNTRACED}: {_line(error)}"
    return library_source(plant, template), plant.numbers


def _why_untraced(system: System, template: str) -> str:
    """Return why a plant cannot be traced, an empty text if it can."""
    try:
        form = plant_form(system)
        traced = _traced(form, template)
        literal = _traced(plant_form(system, True), template) if isinstance(traced, str) else traced
    except Exception as error:  # whatever the user's functions raise
        return f"{_UNTRACED}: {_line(error)}"
    return traced if isinstance(traced, str) and isinstance(literal, str) else ""


def _entry(form: PlantForm, template: str) -> Path | None:
    """Return the file of the index that tells the library of a form; None if it has none."""
    compiler = usable_compilers()[0]
    key = plant_key(form, template, *tools(compiler))
    try:
        return None if key is None else kernel_folder() / f"{key}{PLANT}"
    except OSError:
        return None


def _write(entry: Path | None, content: dict[str, object]) -> None:
    if entry is not None:
        write_json(entry, content)


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
