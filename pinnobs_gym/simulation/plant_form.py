"""What the equations of a system depend on beside its numbers.

Code that is made from traced equations takes the numbers of a system as arguments, so that systems
of one form share it. All else is part of the code.
"""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import is_number

T = TypeVar("T")

_LARGEST = 64
"""Number of results of a function that are kept."""


@dataclass(frozen=True, eq=False)
class PlantForm:
    """A system whose numbers may be replaced by symbols.

    Numbers that are not finite are not among them, because symbols stand for real numbers: SymPy
    takes ``symbol == inf`` as false. Neither are truth values, None, and arrays that are no numbers
    by row. A field that is no physical parameter, such as the time of a step, on which equations
    may branch, is among them only if it differs between rows.
    """

    system: System
    """The system, in whose place one row stands if its numbers differ between rows."""
    numbers: tuple[str, ...]
    """The fields that are symbols."""
    properties: tuple[str, ...]
    """The properties of its class that are symbols. Their values follow from the parameters."""
    key: tuple[Any, ...] | None
    """What systems of the same form have in common; None if that cannot be told."""

    @property
    def rest(self) -> dict[str, Any]:
        """The fields of the system that are no symbols, by name."""
        taken = {"measured_input", *self.numbers}
        names = (f.name for f in fields(self.system) if f.name not in taken)
        return {name: getattr(self.system, name) for name in names}


def plant_form(system: System, literal: bool = False) -> PlantForm:
    """Return the form of a system.

    Args:
        system: the system; parameters may be arrays (batch,) of one number per row.
        literal: keep all numbers as they are, for equations that branch on them.

    Raises:
        ValueError: in one line, if a number that has to be kept differs between rows.
    """
    values = {f.name: getattr(system, f.name) for f in fields(system)}
    by_row = _by_row(system)
    single: dict[str, Any] = {name: float(value[0]) for name, value in by_row.items()}
    if system.measured_input:
        single["measured_input"] = False
    one = replace(system, **single) if single else system
    candidates = [
        n for n in values if n in by_row or (n in one.parameters and is_number(values[n]))
    ]
    numbers = tuple(n for n in candidates if not literal and np.isfinite(values[n]).all())
    kept = next((name for name in by_row if name not in numbers), None)
    if kept is not None:
        why = "f or h branches on it" if literal else "it is not finite in all"
        raise ValueError(f"{kept} differs between rows, and {why}")
    properties = () if literal else _finite_properties(system, one)
    form = PlantForm(one, numbers, properties, None)
    try:
        rest = pickle.dumps(form.rest)
    except Exception:  # whatever pickle raises for a lambda or an open file
        return form
    return replace(form, key=(type(system), numbers, properties, rest))


def first_row(system: System) -> System:
    """Return the system of the first row, if its numbers differ between rows."""
    first = {name: value[:1] for name, value in _by_row(system).items()}
    return replace(system, **first) if first else system


def _by_row(system: System) -> dict[str, np.ndarray]:
    """Return the fields (batch,) of a system that have one number per row."""
    usual, values = (
        _defaults(type(system)),
        {f.name: getattr(system, f.name) for f in fields(system)},
    )
    return {
        name: value
        for name, value in values.items()
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.size and name in usual
    }


def _finite_properties(system: System, one: System) -> tuple[str, ...]:
    names = numeric_properties(one)
    return tuple(n for n in names if np.isfinite(np.asarray(getattr(system, n))).all())


def numeric_properties(system: System) -> list[str]:
    """Return the names of the properties that a system's class defines and that are numbers."""
    own = [name for name, value in vars(type(system)).items() if isinstance(value, property)]
    return [name for name in own if is_number(getattr(system, name))]


@functools.lru_cache(maxsize=256)
def _defaults(cls: type[System]) -> frozenset[str]:
    """Return the names of the fields that are numbers by default."""
    usual = cls()
    return frozenset(f.name for f in fields(usual) if is_number(getattr(usual, f.name)))


def cached_by_form(function: Callable[..., T]) -> Callable[..., T]:
    """Decorate a function of a form and hashable values so that it keeps its latest results for
    forms with equal keys."""
    results: dict[Any, T] = {}

    @functools.wraps(function)
    def call(form: PlantForm, *values: Any) -> T:
        if form.key is None:
            return function(form, *values)
        key = (form.key, values)
        if key not in results:
            if len(results) >= _LARGEST:
                del results[next(iter(results))]
            results[key] = function(form, *values)
        return results[key]

    return call
