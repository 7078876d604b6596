"""The check of what an estimator is given, noise by sample, and the bounds of what it returns, the
same for all estimators.

`BaseEstimator` applies them to the methods ``run``, ``reset`` and ``update`` that a class defines,
so that no estimator has to, and none can broadcast outputs of another number. What is no sample of
a record is no sample of ``update`` either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from typing import Any

import numpy as np
from numpy import vdot as _square

from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.estimation.returned import checked_estimates, checked_state
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Prior, Record, check_use
from pinnobs_gym.simulation.system import System

_INF = float("inf")
_FLOAT = np.dtype(float)


def checked_run(run: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``run(record)`` with `Record.check_fits` before it, and after it
    `checked_estimates` and, if the system's states have bounds, `kept_inside`.

    Where the record has noise by sample, the method is that of an estimator which is told this
    noise.
    """

    @wraps(run)
    def checked(self: Any, record: Record) -> Any:
        record.check_fits(self.system)
        if record.noise_std is not None and not isinstance(self.noise_std, SampledLevel):
            level = SampledLevel(record.t, record.noise_std, self.noise_std)
            self = replace(self, noise_std=level)
        self.ask_model()
        result, box = run(self, record), self.system.state_box
        result = checked_estimates(self, result, record.batch, record.num_samples)
        return result if box is None else kept_inside(result, box)

    return checked


def checked_reset(reset: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``reset(prior)`` with `Prior.check_fits` before it, which also asks for the
    compiled code that updates need, and `checked_state` after it."""

    @wraps(reset)
    def checked(self: Any, prior: Prior) -> Any:
        prior.check_fits(self.system, len(prior.mean))
        self.ask_model()
        return checked_state(self, "reset", reset(self, prior), len(prior.mean), None, None)

    return checked


def checked_update(update: Callable[..., Any]) -> Callable[..., Any]:
    """Return the method ``update(state, t, y, u)`` with a check of the sample before it, and
    after it `checked_state` and, if the system's states have bounds, `kept_inside`.

    The sample has to be what `Record` and `Record.check_fits` accept: a later time, a whole number
    if the system is a map, outputs that are finite or NaN, finite inputs, and those that the system
    defines if it uses no measured ones. What is like an array of real numbers, such as a list, is
    taken as one. The check takes about a microsecond, more for such a system with inputs. The
    attribute ``unchecked`` is the method without it, for the samples of a record,
    which are checked all at once.
    """

    @wraps(update)
    def unchecked(self: Any, state: Any, t: float, y: np.ndarray, u: np.ndarray) -> Any:
        return _checked(self, state, t, len(y), update(self, state, t, y, u))

    @wraps(update)
    def checked(self: Any, state: Any, t: float, y: np.ndarray, u: np.ndarray) -> Any:
        system, batch, nu, before = self.system, len(state.xhat), self.system.nu, state.t
        shapes = (batch, system.ny), (batch, nu)
        try:
            # A sum of squares is finite if all numbers are, unless some are huge.
            usual = (
                (y.shape, u.shape) == shapes
                and y.dtype is _FLOAT
                and u.dtype is _FLOAT
                and not getattr(t, "ndim", 0)
                and (before is None or t > before)
                and -_INF < t < _INF
                and _square(y, y) < _INF
                and (not nu or _square(u, u) < _INF)
            )
        except (AttributeError, TypeError, ValueError):  # of what are no arrays of real numbers
            usual = False
        if not usual:
            _check_sample(system, before, t, y, u, shapes)
            y, u = np.asarray(y, dtype=float), np.asarray(u, dtype=float)
        # Compiled code compares inputs itself.
        by_code = getattr(self, "compiled", None) is not None
        if ((nu and not system.measured_input) or system.discrete) and not by_code:
            check_use(system, np.array([t], dtype=float), np.asarray(u, dtype=float)[:, None])
        return _checked(self, state, t, batch, update(self, state, t, y, u))

    checked.unchecked = unchecked  # pyright: ignore[reportAttributeAccessIssue]
    return checked


def _checked(estimator: Any, before: Any, t: float, batch: int, state: Any) -> Any:
    """Return the state after a sample of so many rows, checked, and with its estimates within the
    system's bounds."""
    # Compiled code returns arrays of these shapes, and has found the estimates inside.
    if getattr(state, "packed", None) is not None:
        return state
    state = checked_state(estimator, "update", state, batch, t, before)
    box = estimator.system.state_box
    return state if box is None else kept_inside(state, box)


def _check_sample(
    system: System,
    before: float | None,
    t: Any,
    y: Any,
    u: Any,
    shapes: tuple[tuple[int, int], tuple[int, int]],
) -> None:
    """Check the sample at t (s) after that at ``before``, None at the first, with outputs y and
    inputs u of these shapes, (batch, ny) and (batch, nu).

    Raises:
        ValueError: in one line that names the value and what was expected.
    """
    for name, values, shape in zip("yu", (y, u), shapes, strict=True):
        if np.shape(values) != shape:
            raise ValueError(
                f"{name} has shape {np.shape(values)}; expected (batch, n{name})={shape} for "
                f"{type(system).__name__}"
            )
    prior = Prior(np.zeros((len(y), system.nx)), np.zeros((len(y), system.nx, system.nx)))
    if np.ndim(t):
        raise ValueError(f"t has shape {np.shape(t)}; expected one number for all rows")
    outputs, inputs = (np.asarray(values)[:, None] for values in (y, u))
    try:
        record = Record(np.asarray(t)[None], outputs, inputs, prior)
    except ValueError as error:
        line = str(error).replace(" at sample 0", f" at t={t}").replace("sample 0", "a sample")
        raise ValueError(line) from None
    if before is not None and not record.t[0] > before:
        raise ValueError(f"t must increase; a sample has t={t} after {before}")
