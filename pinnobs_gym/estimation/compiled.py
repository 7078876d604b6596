"""Filters in compiled code, for estimators whose class names a template.

The code in NumPy stays the reference. A sample that the compiled code leaves to it, because a state
is beyond its bounds or a matrix has no root, is processed in NumPy, in the rows concerned, and so
are rows that are carried by roots. Every row has the same result alone and in any batch, but for a
learned gain in NumPy, whose network is a product of large matrices.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from ctypes import addressof
from typing import TYPE_CHECKING, Protocol

import numpy as np

from pinnobs_gym.estimation.compiled_code import library_of, of_rows, plan_of, rows_of_numbers
from pinnobs_gym.estimation.compiled_layout import Layout, contiguous
from pinnobs_gym.estimation.compiled_run import CompiledRun, call_with, state_of, with_rows
from pinnobs_gym.estimation.estimator import Estimates, State
from pinnobs_gym.estimation.square_root import carried
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import Record, check_use

if TYPE_CHECKING:
    from pinnobs_gym.estimation.recursive import RecursiveEstimator

_LAYOUTS = 16
"""Number of layouts that are kept, one for each number of rows."""


class Compiled(Protocol):
    """The compiled code of an estimator."""

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        ...

    @property
    def run(self) -> Callable[[Record], Estimates | None]:
        """Returns the estimates of a record; None if it is processed sample by sample."""
        ...


def compiled_filter(estimator: RecursiveEstimator) -> Compiled | str:
    """Return the compiled code of an estimator, or the reason in one line why there is none."""
    reason = estimator.not_compiled() if estimator.template else ""
    made = reason or library_of(estimator)
    return made if isinstance(made, str) else estimator.compiled_with(made)


class CompiledFilter:
    """The compiled code of one estimator.

    Args:
        estimator: the estimator; its class names the template.
        made: the library.
    """

    def __init__(self, estimator: RecursiveEstimator, made: PlantLibrary) -> None:
        system = estimator.system
        self._estimator = estimator
        self._sizes = system.nx, system.ny, system.nu
        self._fields = estimator.computes
        self._by_sample = estimator.noise.samples is not None
        self._rows = rows_of_numbers(estimator, made)
        R = estimator.noise.R(0.0)[None]
        self.plan = plan_of(estimator, made, R, **estimator.plan_settings())
        """The first argument of the compiled function."""
        self.run = CompiledRun(estimator, made, self.plan)
        """Returns the estimates of a record; None if NumPy has to process it."""
        self._layouts: dict[int, Layout] = {}
        self.code = made.code.update
        """The compiled function; see ``update`` in ``templates/filter.c``."""
        self.code.argtypes = [
            *(ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_double),
            *[ctypes.c_void_p] * 5,
        ]
        self.code.restype = ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        batch = len(state.xhat)
        layout = self.layout(batch)
        without = state.P is None and "P" in self._fields
        if without or self._rows not in (1, batch):
            return None
        before = state.packed
        if type(before) is not layout.buffer:
            before = layout.packed(state.t, state.u, state.xhat, state.P)
        # All arrays of the next state are parts of one buffer, whose address is found once.
        buffer = layout.buffer()
        plan, given = self.plan, self._estimator.given_noise(state.memory)
        if given is not None:
            plan = plan.with_R(given[None])
        elif self._by_sample:
            plan = plan.with_R(self._estimator.noise.R(t)[None])
        memory, carried_arrays = self._estimator.carried_memory(state.memory)
        more = call_with(carried_arrays) if carried_arrays else None
        left = self.code(
            addressof(plan.structure),
            batch,
            state.t is None,
            t,
            contiguous(y),
            contiguous(u) if self._sizes[2] else None,
            addressof(buffer),
            addressof(before),
            addressof(more) if more else None,
        )
        # The attributes are set at once, in a quarter of the time that State(...) takes.
        after = object.__new__(State)
        arrays = layout.arrays(buffer)
        after.__dict__.update(arrays, t=t, u=u, memory=memory, root=state.root)
        if left:  # the inputs may be others than the model uses
            check_use(
                self._estimator.system,
                np.array([t], dtype=float),
                np.asarray(u, dtype=float)[:, None],
            )
        if left or state.root is not None:
            marks = np.ndarray((batch,), np.int64, buffer, layout.marks)
            return self._completed(state, after, y, marks == 0)
        after.__dict__["packed"] = buffer
        return after

    def _completed(
        self, state: State, after: State, y: np.ndarray, left: np.ndarray
    ) -> State | None:
        """Return the state after a sample, with the rows that are left to NumPy, bool (batch,), and
        those that are carried by roots; None if these are all."""
        if state.root is not None:
            left[carried(state.root)] = True
        if left.all():
            return None
        rows = np.flatnonzero(left)
        if not len(rows):
            return after
        estimator = of_rows(self._estimator, rows)
        assert after.t is not None
        assert after.u is not None
        own = state_of(estimator, state, rows)
        part = estimator.update_by_numpy(
            own, after.t, np.asarray(y)[rows], np.asarray(after.u)[rows]
        )
        for name in self._fields:
            getattr(after, name)[rows] = getattr(part, name)
        return with_rows(self._estimator, after, rows, part)

    def layout(self, batch: int) -> Layout:
        """Return the layout of a buffer for a batch."""
        layout = self._layouts.get(batch)
        if layout is None:
            layout = Layout.of(*self._sizes, batch, self._fields)
            if len(self._layouts) < _LAYOUTS:
                self._layouts[batch] = layout
        return layout
