"""The check of what f and h return later than at their first call, see `probe`: a value of another
shape, which depends on the time or the states, would be broadcast."""

from __future__ import annotations

from typing import Any

from pinnobs_gym.simulation.probe import ModelError
from pinnobs_gym.simulation.system import System


def outputs_at(system: System, t: Any, x: Any, u: Any) -> Any:
    """Return the outputs h(t, x, u), shape (..., ny), of states x, shape (..., nx).

    Raises:
        ModelError: in one line, if they are no array of this shape.
    """
    return of_shape(system, "h", system.h(t, x, u), (*x.shape[:-1], system.ny))


def of_shape(system: System, name: str, value: Any, shape: tuple[int, ...]) -> Any:
    """Return the value of a function of a system.

    Args:
        system: the system.
        name: name of the function.
        value: what it returned.
        shape: the shape that it has to have.

    Raises:
        ModelError: in one line, if it is no array of this shape.
    """
    found = getattr(value, "shape", None)
    if found != shape:
        cls = type(getattr(system, "plant", system)).__name__
        what = type(value).__name__ if found is None else f"shape {tuple(found)}"
        raise ModelError(
            f"{cls}.{name} returned {what}; expected shape {shape}, at every time and state"
        )
    return value
