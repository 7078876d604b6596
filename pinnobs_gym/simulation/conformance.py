"""Helpers shared by the checks of systems and of estimators."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


class CheckFailed(AssertionError):
    """A subject violates its interface; the message has one line per failed check."""


def run_all(checks: Mapping[str, Callable[[T], None]], subject: T) -> None:
    """Run all checks of a table on a subject.

    Raises:
        CheckFailed: if any check fails, with one line per failure.
    """
    failures = []
    for check in checks.values():
        try:
            check(subject)
        except CheckFailed as failure:
            failures.append(str(failure))
    if failures:
        raise CheckFailed("\n".join(failures))


def add_check(
    table: dict[str, Callable[[T], None]], name: str
) -> Callable[[Callable[[T], None]], Callable[[T], None]]:
    """Return a decorator that adds a check to a table. Any exception of the check becomes a
    `CheckFailed` of one line that begins with the check's name."""

    def register(function: Callable[[T], None]) -> Callable[[T], None]:
        @functools.wraps(function)
        def check(subject: T) -> None:
            try:
                function(subject)
            except Exception as error:
                kind = "" if isinstance(error, Found) else f"{type(error).__name__}: "
                what = " ".join(str(error).split())
                raise CheckFailed(f"{name}: {kind}{what}") from error

        table[name] = check
        return check

    return register


class Found(Exception):
    """A fault found by a check, described in one line."""


def require(condition: object, message: str) -> None:
    """Raise `Found` with the message unless the condition holds."""
    if not condition:
        raise Found(message)


def require_shape(array: Any, shape: tuple[int, ...], what: str) -> None:
    """Raise `Found` unless the array has the shape."""
    found = tuple(array.shape)
    require(found == shape, f"{what} has shape {found}; expected {shape}")


def require_close(a: Any, b: Any, tolerance: float, size: Any, what: str) -> None:
    """Raise `Found` unless two arrays agree within a tolerance times the larger of ``abs(b)`` and
    the size. Equal infinities agree, and so do NaN in both."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    require_shape(a, b.shape, what)
    with np.errstate(all="ignore"):
        off = abs(a - b) / np.maximum(abs(b), size)
    off = np.where((a == b) | (np.isnan(a) & np.isnan(b)), 0.0, off)
    largest = off.max(initial=0.0)
    require(
        largest <= tolerance,
        f"{what} differ by {largest:.1e} of scale; expected at most {tolerance:.0e}",
    )
