"""The check of what an estimator is given, noise by sample, and the bounds of what it returns, the
same for all estimators.

`BaseEstimator` applies both to the methods ``run`` and ``update`` that a class defines, so that no
estimator has to, and none can broadcast outputs of another number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np

from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Record


def checked_run(run: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``run(record)`` with `Record.check_fits` before it, and `kept_inside` after
    it if the system's states have bounds.

    Where the record has noise by sample, the method is that of an estimator which is told this
    noise.
    """

    @wraps(run)
    def checked(self: Any, record: Record) -> Any:
        record.check_fits(self.system)
        if record.noise_std is not None and not isinstance(self.noise_std, SampledLevel):
            level = SampledLevel(record.t, record.noise_std, self.noise_std)
            self = replace(self, noise_std=level)
        result, box = run(self, record), self.system.state_box
        return result if box is None else kept_inside(result, box)

    return checked


def checked_update(update: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``update(state, t, y, u)`` with a check of the shapes of y and u before it,
    and `kept_inside` after it if the system's states have bounds.

    The check takes less than a microsecond. Values are checked once per record, by `Record`.
    """

    @wraps(update)
    def checked(self: Any, state: Any, t: float, y: np.ndarray, u: np.ndarray) -> Any:
        system, batch = self.system, len(state.xhat)
        if _shape(y) != (batch, system.ny) or _shape(u) != (batch, system.nu):
            raise ValueError(_unfit(type(system).__name__, batch, system, y, u))
        result, box = update(self, state, t, y, u), system.state_box
        # Compiled code has found the estimates of its states inside.
        if box is None or getattr(result, "packed", None) is not None:
            return result
        return kept_inside(result, box)

    return checked


def _shape(value: Any) -> tuple[int, ...]:
    """Return the shape of an array, or of nested lists, in a fifth of the time of `numpy.shape`."""
    try:
        return value.shape
    except AttributeError:
        return np.shape(value)


def _unfit(kind: str, batch: int, system: Any, y: Any, u: Any) -> str:
    """Return the line that says which of y and u has not the shape of a sample."""
    wrong = [
        f"{name} has shape {np.shape(value)}; expected (batch, n{name})=({batch}, {size})"
        for name, value, size in (("y", y, system.ny), ("u", u, system.nu))
        if np.shape(value) != (batch, size)
    ]
    return f"{wrong[0]} for {kind}"
