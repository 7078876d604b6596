"""Values and type hints: whether a value is of a field's type, and what a type is in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import Field, fields
from functools import cache
from numbers import Complex, Integral, Real
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from pinnobs_gym.simulation.values import LARGEST, shortly

_NUMBERS: dict[Any, tuple[type, str]] = {
    int: (Integral, "whole number"),
    float: (Real, "number"),
    complex: (Complex, "complex number"),
}
"""The abstract type of each type of numbers, which NumPy's belong to, and its name."""


@cache
def field_hints(kind: type) -> Mapping[str, Any]:
    """Return the types of a dataclass's fields by name; none if its hints name what cannot be
    found when the program runs."""
    try:
        hints = get_type_hints(kind)
    except NameError:
        return {}
    return {f.name: hints[f.name] for f in fields(kind)}


def fits(value: Any, hint: Any) -> bool:
    """Return whether a value is of a type. A whole number is also a number, but True and NaN are
    none, nor are numbers too large to compute with. A list is as good as a tuple, because TOML and
    JSON have lists only."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return fits(value, parts[0])
    if origin in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if origin is Literal:
        return any(type(value) is type(word) and value == word for word in parts)
    if hint in (None, NoneType):
        return value is None
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint][0]) and _usable(value)
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    kind = origin or hint
    if kind is tuple:
        return isinstance(value, tuple | list) and _items_fit(value, parts)
    if kind in (list, Sequence):
        if isinstance(value, np.ndarray):
            return value.ndim > 0 and _items_fit(list(value), (*parts, ...))
        several = isinstance(value, Sequence) and not isinstance(value, str | bytes)
        return several and _items_fit(value, (*parts, ...))
    if kind is Any or not isinstance(kind, type):
        return True
    try:
        if not isinstance(value, kind):
            return False
    except TypeError:  # a protocol that is not checked when the program runs
        return True
    if parts and isinstance(value, Mapping):
        return all(fits(n, parts[0]) and fits(v, parts[1]) for n, v in value.items())
    return True


def _usable(value: Any) -> bool:
    """Return whether a number can be computed with: it is no truth value, not NaN, and neither
    finite and beyond `LARGEST`, nor a whole number of more than 64 bits."""
    if isinstance(value, bool) or value != value:
        return False
    if isinstance(value, Integral):
        return abs(int(value)) < 2**63
    return abs(value) <= LARGEST or abs(value) == math.inf


def _items_fit(value: Sequence[Any], parts: Sequence[Any]) -> bool:
    """Return whether the items of a tuple are of the types in its hint."""
    if parts in ((), (...,)):  # the hint names none
        return True
    if parts[-1] is Ellipsis:
        return all(fits(item, parts[0]) for item in value)
    return len(value) == len(parts) and all(map(fits, value, parts))


def check_field(name: str, value: Any, hint: Any) -> None:
    """Check the type of a field's value.

    Raises:
        ValueError: in one line, naming the field, its value and what was expected.
    """
    if not fits(value, hint):
        raise ValueError(f"{name}={shortly(value)}; expected {in_words(hint)}")


def check_settings(settings: Any, chosen: Iterable[Field[Any]]) -> None:
    """Check the types of these fields of a dataclass, except where they have their defaults.

    Raises:
        ValueError: in one line, naming the field, its value and what was expected.
    """
    hints = field_hints(type(settings))
    for each in chosen:
        value = getattr(settings, each.name)
        if value is not each.default:
            check_field(each.name, value, hints.get(each.name, Any))


def as_tuple(value: Any, hint: Any) -> Any:
    """Return a list as a tuple if that is its type; other values unchanged."""
    within = (hint, *get_args(hint))  # also within an optional type
    wanted = isinstance(value, list) and any(tuple in (h, get_origin(h)) for h in within)
    return tuple(value) if wanted else value


def in_words(hint: Any) -> str:
    """Return what a value of the type is, for error messages."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return in_words(parts[0])
    if origin in (Union, UnionType):
        return _either(in_words(part) for part in sorted(parts, key=lambda p: p is not NoneType))
    if origin is Literal:
        return _either(map(str, parts))
    if hint in (None, NoneType):
        return "None"
    if hint in _NUMBERS:
        return f"a {_NUMBERS[hint][1]}"
    if hint is bool:
        return "True or False"
    if hint is str:
        return "a text"
    kind = origin or hint
    if kind in (tuple, list, Sequence):
        return _list_in_words(parts)
    return f"a value of type {getattr(kind, '__name__', kind)}"


def _list_in_words(parts: Sequence[Any]) -> str:
    """Return what a list or tuple of the types in its hint is."""
    kinds = [part for part in parts if part is not Ellipsis]
    if not kinds:
        return "a list"
    if len(set(kinds)) > 1:
        return f"a list of {', '.join(map(in_words, kinds))}"
    count = f"{len(kinds)} " if len(kinds) == len(parts) > 1 else ""
    return f"a list of {count}{_several(kinds[0])}"


def _several(hint: Any) -> str:
    """Return what several values of a type are."""
    origin = get_origin(hint) or hint
    if hint in _NUMBERS:
        return f"{_NUMBERS[hint][1]}s"
    if hint is str:
        return "texts"
    if origin in (tuple, list, Sequence):
        return in_words(hint).replace("a list", "lists", 1)
    return f"values, each {in_words(hint)}"


def _either(words: Iterable[str]) -> str:
    """Join alternatives by commas and a final "or"."""
    *others, last = dict.fromkeys(words)
    return f"{', '.join(others)} or {last}" if others else last
