"""The check of what an estimator returns, so that no array of another shape is broadcast, and no
complex number, text or None becomes a number."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

_FLOAT = np.dtype(float)
_FIELDS = ("xhat", "P", "innovation", "S", "outside")
_AXES = {
    **{"xhat": ("nx",), "P": ("nx", "nx")},
    **{"innovation": ("ny",), "S": ("ny", "ny"), "outside": ()},
}


@lru_cache(maxsize=256)
def _shapes(lead: tuple[int, ...], nx: int, ny: int) -> tuple[tuple[int, ...], ...]:
    """Return the shapes of the fields, given the axes before those of states and outputs."""
    sizes = {"nx": nx, "ny": ny}
    return tuple((*lead, *(sizes[axis] for axis in _AXES[name])) for name in _FIELDS)


def checked_state(
    estimator: Any, method: str, state: Any, batch: int, t: float | None, before: Any
) -> Any:
    """Return the state that a method of an estimator returned, with arrays of floats.

    The usual case takes about a microsecond.

    Args:
        estimator: the estimator.
        method: name of the method.
        state: what it returned.
        batch: number of rows.
        t: time of the sample in s; None of ``reset``.
        before: the state before the sample, if any, whose fields tell which are given.

    Raises:
        TypeError: in one line, if it is no state, or a field does not consist of real numbers.
        ValueError: in one line, if a field has another shape, or is there at some samples only.
    """
    try:
        xhat, P, innovation, S = state.xhat, state.P, state.innovation, state.S
        outside = state.outside
    except AttributeError:
        kind = type(state).__name__
        raise TypeError(
            f"{type(estimator).__name__}.{method} returned {kind}; expected a State"
        ) from None
    if before is not None and before.t is not None:
        same = (P is None) is (before.P is None)
        same = same and (innovation is None) is (before.innovation is None)
        same = same and (outside is None) is (before.outside is None)
        if not (same and (S is None) is (before.S is None)):
            _refuse_some_samples(_at(estimator, method, t), state, before)
    system = estimator.system
    shapes = _shapes((batch,), system.nx, system.ny)
    for value, shape in zip((xhat, P, innovation, S, outside), shapes, strict=True):
        if value is None and shape is not shapes[0]:
            continue
        if not (type(value) is np.ndarray and value.shape == shape and value.dtype is _FLOAT):
            return _converted(_at(estimator, method, t), state, ("batch",), shapes)
    return state


def checked_estimates(estimator: Any, estimates: Any, batch: int, num_samples: int) -> Any:
    """Return the estimates that ``run`` of an estimator returned, with arrays of floats.

    Raises:
        TypeError: in one line, if they are no estimates, or a field does not consist of real
            numbers.
        ValueError: in one line, if a field has another shape.
    """
    at = _at(estimator, "run", None)
    if not all(hasattr(estimates, name) for name in _FIELDS):
        raise TypeError(f"{at} returned {type(estimates).__name__}; expected Estimates")
    system = estimator.system
    shapes = _shapes((batch, num_samples), system.nx, system.ny)
    return _converted(at, estimates, ("batch", "num_samples"), shapes)


def _at(estimator: Any, method: str, t: float | None) -> str:
    """Return which method returned something, and at which sample."""
    return f"{type(estimator).__name__}.{method}" + ("" if t is None else f", at t={t:g} s,")


def _refuse_some_samples(at: str, state: Any, before: Any) -> None:
    for name in _FIELDS[1:]:
        value = getattr(state, name)
        if (value is None) != (getattr(before, name) is None):
            found = "None" if value is None else "an array"
            raise ValueError(f"{at} returned {found} as {name}, unlike at the sample before")


def _converted(at: str, result: Any, lead: tuple[str, ...], shapes: Any) -> Any:
    """Return a result with its fields as arrays of floats, after a check of each."""
    changes: dict[str, np.ndarray] = {}
    for name, shape in zip(_FIELDS, shapes, strict=True):
        value = getattr(result, name)
        if value is None and name != "xhat":
            continue
        expected = f"expected ({', '.join((*lead, *_AXES[name]))})={shape}"
        try:
            array = np.asarray(value)
        except Exception:  # such as of lists of several lengths, or a tensor with a gradient
            raise TypeError(f"{at} returned a {name} that is no array; {expected}") from None
        if array.dtype.kind not in "iuf":
            kind = "None" if value is None else f"numbers of type {array.dtype}"
            raise TypeError(f"{at} returned {kind} as {name}; {expected}, real numbers")
        if array.shape != shape:
            raise ValueError(f"{at} returned {name} of shape {array.shape}; {expected}")
        if array is not value or array.dtype != _FLOAT:
            changes[name] = array.astype(float)
    return replace(result, **changes) if changes else result
