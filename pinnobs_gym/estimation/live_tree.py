"""States of estimators as plain values and arrays, and back.

Names of classes are looked up among the dataclasses that the modules of the estimator's class know,
and those of the estimators that it imports, such as a fallback: what is not imported there is never
made, so that a file cannot say what code runs.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from itertools import chain
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator, State

_KINDS = "biufc"
"""Kinds of NumPy's types of numbers and truth values."""


class Tree:
    """The conversion for one estimator.

    Args:
        estimator: the estimator.
        arrays: the arrays for which numbers in plain values stand.
    """

    def __init__(self, estimator: BaseEstimator, arrays: Iterable[np.ndarray] = ()) -> None:
        self.arrays = list(arrays)
        self._places = {id(array): place for place, array in enumerate(self.arrays)}
        self._label = type(estimator).__name__
        self._classes: dict[str, type] = {State.__qualname__: State}
        own = _known_to(type(estimator))
        imported = [_known_to(cls) for cls in own if issubclass(cls, BaseEstimator)]
        for cls in chain(own, *imported):
            self._classes.setdefault(cls.__qualname__, cls)

    def plain(self, value: Any) -> Any:
        """Return a value as JSON values, with numbers that stand for places in `arrays`. Arrays
        that are not there are added.

        Raises:
            ValueError: in one line, if a part is neither data nor a dataclass that is known.
        """
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, np.ndarray | np.generic):
            return self._plain_array(value)
        if isinstance(value, tuple | list) and type(value) in (tuple, list):
            return {type(value).__name__: [self.plain(each) for each in value]}
        if isinstance(value, Mapping):
            pairs = [[key, self.plain(each)] for key, each in value.items()]
            return {"dict": pairs}
        kind: Any = type(value)
        if self._classes.get(kind.__qualname__) is kind:
            names = [f.name for f in fields(kind) if f.init]
            parts = {name: self.plain(getattr(value, name)) for name in names}
            return {"class": kind.__qualname__, "fields": parts}
        raise ValueError(
            f"{self._label} remembers a {kind.__name__}, which cannot be saved; expected arrays, "
            "numbers, texts, tuples, lists, dicts, and dataclasses that its module knows"
        )

    def value(self, plain: Any) -> Any:
        """Return the value of a `plain` one.

        Raises:
            LookupError, TypeError, ValueError: if it is not one.
        """
        if not isinstance(plain, dict):
            return plain
        if "array" in plain:
            array = self.arrays[plain["array"]]
            return array[()] if plain.get("scalar") else array
        if "dict" in plain:
            return {key: self.value(each) for key, each in plain["dict"]}
        if "class" in plain:
            kind, parts = self._classes[plain["class"]], plain["fields"]
            if set(parts) != {f.name for f in fields(kind) if f.init}:
                raise TypeError(f"the fields of {plain['class']} are others")
            return kind(**{name: self.value(each) for name, each in parts.items()})
        ((name, parts),) = plain.items()
        return {"tuple": tuple, "list": list}[name](self.value(each) for each in parts)

    def _plain_array(self, value: Any) -> dict[str, Any]:
        """Return what stands for an array, or a scalar of NumPy."""
        if value.dtype.kind not in _KINDS:
            raise ValueError(
                f"{self._label} remembers an array of {value.dtype}, which cannot be saved"
            )
        scalar = isinstance(value, np.generic)
        array = np.asarray(value)
        place = self._places.setdefault(id(array), len(self.arrays))
        if place == len(self.arrays):
            self.arrays.append(array)
        return {"array": place, "scalar": True} if scalar else {"array": place}


def _known_to(cls: type) -> list[type]:
    """Return the dataclasses that the modules of a class and of its bases know."""
    modules = [sys.modules.get(base.__module__) for base in cls.__mro__]
    values = [value for module in filter(None, modules) for value in tuple(vars(module).values())]
    return [value for value in values if isinstance(value, type) and is_dataclass(value)]


def in_memory_order(array: np.ndarray) -> tuple[np.ndarray, list[int]]:
    """Return an array with its axes in the order in which memory has them, and that order. Sums are
    formed along it, so that another order would give other roundings."""
    order = np.argsort([-abs(stride) for stride in array.strides], kind="stable").tolist()
    return np.array(array.transpose(order), order="C"), order
