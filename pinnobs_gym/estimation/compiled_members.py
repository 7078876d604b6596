"""What ensembles and particles share in compiled code: a set of points for each row.

The code in NumPy stays the reference. Rows that the compiled code leaves to it, because a model is
not defined at a point, a point is beyond its bounds or a matrix has no root, are processed in
NumPy. Every row has the same result alone and in any batch.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from ctypes import addressof
from typing import Any, NamedTuple

import numpy as np

from pinnobs_gym.estimation.compiled_code import of_rows, plan_of, rows_of_numbers
from pinnobs_gym.estimation.compiled_layout import SetLayout
from pinnobs_gym.estimation.compiled_run import state_of
from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.estimation.random_streams import Streams
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import check_use

LEFT = 1
"""The mark of rows that are left to NumPy; see ``members.c``."""
_POINTER, _INT, _DOUBLE = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_LAYOUTS = 16
"""Number of layouts that are kept, one for each number of rows."""


class SetStructure(ctypes.Structure):
    """``struct set`` of ``members.c``."""

    _fields_ = [
        *(("members", _INT), ("num_more", _INT), ("inflation", _DOUBLE)),
        *(("few", _DOUBLE), ("collapsed", _DOUBLE)),
        *(("plan", _POINTER), ("batch", _INT), ("first", _INT), ("t", _DOUBLE)),
        *((name, _POINTER) for name in ("to", "before", "draws", "more", "G")),
        *(("G_rows", _INT), ("most", _DOUBLE), ("rounds", _INT)),
        *(("shrinkage", _POINTER), ("uniform", _DOUBLE), ("y", _POINTER), ("u", _POINTER)),
    ]


class SetCall(NamedTuple):
    """A call for one sample."""

    structure: SetStructure
    layout: SetLayout
    buffer: Any
    """The buffer of the state after the sample."""
    kept: tuple[Any, ...]
    """What has to live until the call has been made."""

    @property
    def place(self) -> int:
        """The address of the structure."""
        return addressof(self.structure)

    def marks(self) -> np.ndarray:
        """Return what is to be done in each row, (batch,)."""
        batch = self.structure.batch
        return np.ndarray((batch,), np.int64, self.buffer, self.layout.layout.marks)


class SetCode:
    """What compiled code of sets of points needs at each sample.

    Args:
        estimator: the estimator, which has a ``seed``. Its memory has arrays in the order of
            ``shapes``, then the number of samples.
        made: its library.
        members: number of points of a row.
        shapes: shapes of the arrays of a row, as of `SetLayout`.
        settings: fields of ``struct set`` that are the same at all samples.
    """

    def __init__(
        self,
        estimator: Any,
        made: PlantLibrary,
        members: int,
        shapes: Sequence[tuple[int, ...]],
        **settings: float,
    ) -> None:
        system = estimator.system
        self._estimator, self._members = estimator, members
        self._sizes, self._shapes = (system.nx, system.ny, system.nu), shapes
        self._by_sample = estimator.noise.samples is not None
        self._rows = rows_of_numbers(estimator, made)
        self._plan = plan_of(estimator, made, estimator.noise.R(0.0)[None])
        m = self._plan.structure.m
        self._normal = m if system.discrete else 2 * m
        self._constant = SetStructure(members, **settings)
        self._steps = made.code.noisy_steps
        self._steps.argtypes, self._steps.restype = [_POINTER, _DOUBLE, _DOUBLE], _INT
        self._layouts: dict[int, SetLayout] = {}
        self.streams = Streams(estimator.seed, made.code)
        """The random numbers of the estimator."""

    def call(self, state: State, t: float, stream: tuple[int, ...]) -> SetCall | None:
        """Return the call for a sample; None if NumPy has to process it.

        Args:
            state: the state before.
            t: time of the sample in s.
            stream: numbers of the random stream of the process noise.
        """
        batch = len(state.xhat)
        if self._rows not in (1, batch) or state.P is None:
            return None
        plan, draws = self._plan, None
        if self._normal and state.t is not None:
            count = self._steps(addressof(plan.structure), state.t, t)
            if count < 0:
                return None
            size = count, self._members, self._normal
            draws = self.streams.at(*stream).standard_normal(size)
        if self._by_sample:
            plan = plan.with_R(self._estimator.noise.R(t)[None])
        layout = self._layout(batch)
        buffer, before = layout.layout.buffer(), state.packed
        if type(before) is not layout.layout.buffer:
            before = self._packed(layout, state)
        call = SetStructure.from_buffer_copy(self._constant)
        call.plan, call.batch, call.t = addressof(plan.structure), batch, t
        call.first = state.t is None
        call.to, call.before = addressof(buffer), addressof(before)
        if draws is not None:
            call.draws = place(draws)
        return SetCall(call, layout, buffer, (plan, before, draws))

    def after(
        self, state: State, call: SetCall, y: np.ndarray, u: np.ndarray, *, left: bool
    ) -> State:
        """Return the state after a sample.

        Args:
            state: the state before.
            call: the call.
            y: outputs, shape (batch, ny).
            u: inputs, shape (batch, nu).
            left: whether rows are left to NumPy.
        """
        buffer, t = call.buffer, call.structure.t
        moments = call.layout.layout.arrays(buffer)
        memory = state.memory
        memory = type(memory)(*call.layout.arrays(buffer), memory.sample + 1)
        # The attributes are set at once, in a quarter of the time that State(...) takes.
        after = object.__new__(State)
        after.__dict__.update(moments, t=t, u=u, memory=memory, packed=buffer)
        if left:
            self._complete(state, after, call, y)
        return after

    def _complete(self, state: State, after: State, call: SetCall, y: np.ndarray) -> None:
        """Process the rows that are left to NumPy."""
        t, u, system = call.structure.t, np.asarray(after.u, dtype=float), self._estimator.system
        # The inputs may be others than the model uses.
        check_use(system, np.array([t], dtype=float), u[:, None])
        rows = np.flatnonzero(call.marks() & LEFT)
        estimator = of_rows(self._estimator, rows)
        own = state_of(estimator, state, rows)
        part = estimator.update_by_numpy(own, t, np.asarray(y)[rows], u[rows])
        if system.state_box is not None:
            part = kept_inside(part, system.state_box)
        for name in self._estimator.computes:
            getattr(after, name)[rows] = getattr(part, name)
        values = vars(part.memory).values()
        for array, value in zip(call.layout.arrays(call.buffer), values, strict=False):
            array[(slice(None),) * (array.ndim > 1) + (rows,)] = value

    def _packed(self, layout: SetLayout, state: State) -> Any:
        """Return a new buffer with the memory of a state."""
        assert state.P is not None
        buffer = layout.layout.packed(state.t, state.u, state.xhat, state.P)
        for array, value in zip(layout.arrays(buffer), vars(state.memory).values(), strict=False):
            array[:] = value
        return buffer

    def _layout(self, batch: int) -> SetLayout:
        layout = self._layouts.get(batch)
        if layout is None:
            layout = SetLayout.of(self._sizes, self._shapes, batch)
            if len(self._layouts) < _LAYOUTS:
                self._layouts[batch] = layout
        return layout


def place(array: Any) -> int:
    """Return the address of a contiguous array of doubles that may be written to, faster than
    NumPy."""
    return addressof(_DOUBLE.from_buffer(array))
