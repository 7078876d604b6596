"""Jacobians of a plant's equations, for systems that write none.

In NumPy they are those of the traced equations (`pinnobs_gym.simulation.traced_code`), exact to
rounding, and central differences where the equations cannot be traced. Of torch tensors they are
found by forward-mode differentiation in torch, which keeps gradients.

The first traced Jacobian takes 0.2 to 0.5 s, most of it to import SymPy; differences take three to
four times as long per call, which only makes up for it after some ten thousand calls. The choice
does not depend on the number of calls, so that results do not, either.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from array_api_compat import is_torch_array

from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.residual import Periods, residual
from pinnobs_gym.simulation.system import Array, System, vector

_STEP = float(np.cbrt(np.finfo(float).eps))
"""Relative step of differences; the cube root of the rounding error minimises their error."""
_LARGEST = 64
"""Number of systems whose functions are kept at hand."""

Function = Callable[[System, Array, np.ndarray, Array], np.ndarray]
"""A Jacobian as a function of the system, t, x and u."""


def jacobian(system: System, name: str, t: Array, x: Array, u: Array) -> Array:
    """Return ∂f/∂x or ∂h/∂x, (..., m, nx), of the function called ``f`` or ``h``, in the library
    of x.

    At a jump or a kink the derivative in NumPy is that of one side, or for `maximum` and `minimum`
    the mean of both sides; a jump itself contributes nothing. Where the function cannot be traced,
    because it branches on numbers or calls functions that are not in
    `pinnobs_gym.simulation.expressions.FUNCTIONS`, the log says so once, and the derivative is
    found by `central_differences`.
    """
    if not isinstance(x, np.ndarray):
        if is_torch_array(x):
            return _by_torch(system, name, t, x, u)
        x = np.asarray(x)
    if x.dtype.kind != "f":
        x = x.astype(float)
    with np.errstate(all="ignore"):  # both branches of a choice are evaluated
        return _function(system, name, t, x, u)(system, t, x, u)


def traced_jacobian(system: System, name: str, t: Array, x: np.ndarray, u: Array) -> Any:
    """Return the Jacobian of the traced equations of ``f`` or ``h``, (..., m, nx), whether the
    system has one of its own or not, or None if they cannot be traced."""
    with np.errstate(all="ignore"):
        try:
            return _traced(system, name, t, x, u)(system, t, x, u)
        except ValueError:
            return None


def origin(system: System, name: str, t: Array, x: np.ndarray, u: Array) -> str:
    """Return in a few words where the Jacobian of ``f`` or ``h`` comes from, given the arguments
    of a call."""
    if getattr(type(system), f"{name}_jacobian") is not getattr(System, f"{name}_jacobian"):
        return "written by hand"
    with np.errstate(all="ignore"):
        try:
            _traced(system, name, t, x, u)
        except ValueError as error:
            return f"found by finite differences, because it cannot be traced ({error})"
    return "derived from its equations"


def central_differences(
    function: Callable[[np.ndarray], Any],
    x: np.ndarray,
    scale: Sequence[float] | np.ndarray,
    columns: Sequence[int] | None = None,
    periods: Periods | None = None,
) -> np.ndarray:
    """Return the derivatives of a function by components of x, (..., m, number of columns).

    The step is 6e-6 of the larger of the component and its scale. The error is then about 1e-10 of
    the function's value, relative to that size, for functions that vary smoothly over the scale. At
    a jump of the function the result is the jump over twice the step.

    Args:
        function: returns (..., m) for x with any leading axes.
        x: where, shape (..., nx).
        scale: scale of each component, shape (nx,).
        columns: the components; all by default.
        periods: periods of the function's values, see `System.output_period`.
    """
    chosen = list(range(x.shape[-1]) if columns is None else columns)
    count, size = len(chosen), np.asarray(scale, dtype=float)
    points = np.repeat(x[None].astype(float), 2 * count, axis=0)
    for i, j in enumerate(chosen):
        step = _STEP * np.maximum(abs(x[..., j]), size[j])
        points[i, ..., j] += step
        points[count + i, ..., j] -= step
    value = np.asarray(function(points))
    # The distance between the points as they were rounded
    width = [points[i, ..., j] - points[count + i, ..., j] for i, j in enumerate(chosen)]
    slopes = residual(value[:count], value[count:], periods) / np.stack(width)[..., None]
    return np.moveaxis(slopes, 0, -1).astype(x.dtype, copy=False)


_latest: dict[tuple[int, str], tuple[weakref.ref[System], Function]] = {}
"""The Jacobians of the systems used last, by the system's identity and the function's name."""


def _function(system: System, name: str, t: Array, x: np.ndarray, u: Array) -> Function:
    """Return the Jacobian, which is chosen at the first call for a system."""
    key = id(system), name
    known = _latest.get(key)
    if known is not None and known[0]() is system:
        return known[1]
    try:
        found = _traced(system, name, t, x, u)
    except ValueError as error:
        say_once(
            f"{type(system).__name__}.{name} cannot be differentiated by its equations ({error}); "
            f"its Jacobian is found by finite differences"
        )
        found = _by_differences(name)
    if len(_latest) >= _LARGEST:
        del _latest[next(iter(_latest))]
    _latest[key] = weakref.ref(system), found
    return found


def _traced(system: System, name: str, t: Array, x: np.ndarray, u: Array) -> Function:
    """Return the Jacobian of the traced equations.

    Raises:
        ValueError: in one line, if they cannot be traced, or at the given states do not give the
            function's own values, as with a branch on the type of an argument.
    """
    from pinnobs_gym.simulation.traced_code import traced_code

    code = traced_code(system, name)
    own = np.asarray(getattr(system, name)(t, x, u))
    try:
        value, slopes = code.value(system, t, x, u), abs(code.jacobian(system, t, x, u))
    except Exception as error:  # such as Python's own division by zero
        raise ValueError(f"{type(error).__name__}: {error}") from error
    scale = vector(system.scale, system.nx, "scale")
    # Rounding errors are relative to the terms of a value, of which the value may be a difference.
    terms = (slopes * np.maximum(abs(x), scale)[..., None, :]).sum(axis=-1)
    allowed = np.sqrt(np.finfo(x.dtype).eps) * (abs(own) + terms)
    if own.shape != value.shape or not _same(own, value, allowed):
        raise ValueError("the traced equations give other values")
    return code.jacobian


def _same(a: np.ndarray, b: np.ndarray, allowed: np.ndarray) -> bool:
    """Return whether the differences are at most those allowed; NaN and infinities are equal."""
    both_nan = np.isnan(a) & np.isnan(b)
    return bool((both_nan | (a == b) | (abs(a - b) <= allowed) | np.isnan(allowed)).all())


def _by_differences(name: str) -> Function:
    def function(system: System, t: Array, x: np.ndarray, u: Array) -> np.ndarray:
        own, scale = getattr(system, name), vector(system.scale, system.nx, "scale")
        periods = system.output_period if name == "h" else None
        return central_differences(lambda x: own(t, x, u), x, scale, periods=periods)

    return function


def _by_torch(system: System, name: str, t: Array, x: Array, u: Array) -> Array:
    """Return the Jacobian of torch tensors."""
    import torch

    from pinnobs_gym.simulation.probe import probe_torch

    probe_torch(type(system), name)
    function: Callable[..., Array] = getattr(system, name)
    now, inputs = [
        other
        if isinstance(other, torch.Tensor)
        else torch.tensor(other, dtype=x.dtype, device=x.device)
        for other in (t, u)
    ]
    nx = x.shape[-1]
    # One forward derivative per unit vector, all in one batch.
    directions = torch.eye(nx, dtype=x.dtype, device=x.device)
    directions = directions.reshape(nx, *([1] * (x.ndim - 1)), nx)
    repeated = x.expand(nx, *x.shape).clone()
    tangents = directions.expand(repeated.shape).clone()
    columns = torch.func.jvp(lambda x: function(now, x, inputs), (repeated,), (tangents,))[1]
    return torch.movedim(columns, 0, -1)
