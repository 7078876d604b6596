"""Values that a user gives: whether they are real numbers, and how messages show them."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

LARGEST = 1e30
"""Largest number that is taken for a state, a level of noise or a setting, the powers of which do
not overflow."""
MOST_POINTS = 10**6
"""Largest number of particles or members of an ensemble, whose states are all in memory."""
_LARGEST_DOUBLE = int(sys.float_info.max)
_SHOWN = 60
"""Largest number of characters that a message shows of a value."""


def is_number(value: object) -> bool:
    """Return whether a value is a real number that double precision holds, infinite and NaN ones
    included. Truth values and texts are none."""
    if isinstance(value, float | np.integer | np.floating):
        return True
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= _LARGEST_DOUBLE


def is_finite(value: Any) -> bool:
    """Return whether a value is a number, and finite."""
    return is_number(value) and math.isfinite(value)


def is_whole(value: object, least: int = 0) -> bool:
    """Return whether a value is a whole number of at least ``least``. Truth values are none."""
    whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    return whole and int(value) >= least  # pyright: ignore[reportArgumentType]


def check_seed(seed: Any) -> int:
    """Return a seed.

    Raises:
        ValueError: in one line, if it is not a whole number of at least 0.
    """
    if not is_whole(seed):
        raise ValueError(f"seed={shortly(seed)}; expected a whole number of at least 0")
    return int(seed)


def check_points(name: str, number: int) -> None:
    """Check the number of points by which an estimator represents a distribution.

    Raises:
        ValueError: in one line, unless it is from 2 to `MOST_POINTS`.
    """
    if not 2 <= number <= MOST_POINTS:
        raise ValueError(f"{name}={shortly(number)}; expected from 2 to {MOST_POINTS}")


def real_array(name: str, value: Any, *, truths: bool = False) -> np.ndarray:
    """Return a value as an array of real numbers in double precision.

    Args:
        name: of the value, for messages.
        value: a number, an array, or what is like one.
        truths: whether truth values count as 0 and 1.

    Raises:
        ValueError: in one line, if it holds anything else, such as texts, complex numbers or dates,
            or masked elements.
    """
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise ValueError(f"{name} has masked elements; expected numbers, NaN where one is missing")
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError):  # such as a list of lists of unequal lengths
        raise ValueError(f"{name}={shortly(value)}; expected an array of real numbers") from None
    if array.dtype.kind not in ("biuf" if truths else "iuf"):
        first = f", such as {shortly(array.ravel()[:1].tolist()[0])}" if array.size else ""
        raise ValueError(f"{name} holds values of type {array.dtype}{first}; expected real numbers")
    return array.astype(float, copy=False)


def finite_array(name: str, value: Any) -> np.ndarray:
    """Return a value as an array of finite numbers up to `LARGEST` in double precision.

    Raises:
        ValueError: in one line, if it holds anything else.
    """
    try:
        array = real_array(name, value)
    except ValueError:
        array = np.array(np.nan)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}={shortly(value)}; expected finite numbers")
    if abs(array).max(initial=0.0) > LARGEST:
        raise ValueError(f"{name}={shortly(value)}; expected numbers up to {LARGEST:g}")
    return array


def check_mapping(parameters: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return parameters by name.

    Raises:
        ValueError: in one line, if they are something else.
    """
    if not isinstance(parameters, Mapping):
        raise ValueError(f"parameters={shortly(parameters)}; expected values by name")
    return parameters


def check_parameters(system: type, values: Mapping[str, Any]) -> None:
    """Check the values of parameters that are numbers by default: they have to be finite numbers,
    or arrays of them. A default that is not finite may be given, too.

    Args:
        system: the class, a dataclass.
        values: of parameters, by name.

    Raises:
        ValueError: in one line that names the parameter, its value and what was expected.
    """
    for each in fields(system):
        value: Any = values.get(each.name)
        default: Any = each.default
        if value is None or value is default or not is_number(default):
            continue
        # An array has a number for each episode of a batch.
        try:
            known = is_number(value) or isinstance(value, np.ndarray)
            array = real_array(each.name, value) if known else np.array(np.nan)
        except ValueError:
            array = np.array(np.nan)
        if not (np.isfinite(array) | (math.isinf(default) & np.isinf(array))).all():
            raise ValueError(
                f"{each.name}={shortly(value)} of {system.__name__}; expected a finite number"
            )


def shortly(value: Any) -> str:
    """Return a value's representation in one line of limited length."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python writes no whole number of more than some thousand digits
        if not isinstance(value, int):
            return f"a {type(value).__name__} of huge numbers"
        return f"a whole number of about {int(value.bit_length() * math.log10(2)) + 1} digits"
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."
