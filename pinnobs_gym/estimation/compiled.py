"""Filters in compiled code, for estimators whose class names a template.

The code in NumPy stays the reference. A sample that the compiled code leaves to it, because a state
is beyond its bounds or a matrix has no root, is processed in NumPy, in the rows concerned, and so
are rows that are carried by roots. Every row has the same result alone and in any batch.
"""

from __future__ import annotations

import ctypes
import inspect
import math
from ctypes import addressof
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates, State
from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.estimation.square_root import carried
from pinnobs_gym.simulation.kernels.calls import CallStructure, Plan, address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary, plant_library
from pinnobs_gym.simulation.noise import AssumedNoise, Noise, SampledLevel
from pinnobs_gym.simulation.record import Record, check_use
from pinnobs_gym.simulation.truth import rows_of

if TYPE_CHECKING:
    from pinnobs_gym.estimation.recursive import RecursiveEstimator

_FIELDS = ("xhat", "P", "innovation", "S")
"""The fields of `Estimates` that compiled filters compute."""
_DOUBLE = np.dtype(float)
_LAYOUTS = 16
"""Number of layouts that are kept, one for each number of rows."""


@dataclass(frozen=True, eq=False)
class _Layout:
    """A buffer that has all arrays of a state one after the other: the time, outputs, inputs,
    estimates, covariances, innovations and their covariances of a batch, and the numbers by which
    compiled code marks rows; see ``update`` in ``templates/filter.c``."""

    buffer: Any
    """The type of the buffer."""
    u: int
    """Position of the inputs in bytes."""
    views: tuple[tuple[tuple[int, ...], int, tuple[int, ...]], ...]
    """Shape, position in bytes and strides of the estimates (batch, nx) and so on."""
    marks: int
    """Position of the numbers that mark rows in bytes."""


def compiled_filter(estimator: RecursiveEstimator) -> CompiledFilter | str:
    """Return the compiled code of an estimator, or the reason in one line why there is none."""
    template = estimator.template
    if not template:
        return f"{type(estimator).__name__} has no compiled code"
    changed = _changed(type(estimator))
    if changed:
        return f"{type(estimator).__name__} defines {changed}"
    noise = estimator.noise
    if type(noise) is not AssumedNoise or type(noise.told) is not Noise:
        return "its noise has methods of its own"
    if reason := estimator.not_compiled():
        return reason
    made = plant_library(estimator.system, template)
    return made if isinstance(made, str) else CompiledFilter(estimator, made)


def _changed(cls: type[RecursiveEstimator]) -> str:
    """Return the name of a method of the class that names the template which a subclass of it
    overrides, an empty text if there is none."""
    classes = cls.__mro__
    place = next(i for i, each in enumerate(classes) if "template" in vars(each))
    for name, value in ((n, v) for each in classes[:place] for n, v in vars(each).items()):
        before = getattr(classes[place], name, None)
        if name.startswith("__") or name == "run" or not inspect.isfunction(value):
            continue
        if before is not None and not getattr(before, "__isabstractmethod__", False):
            return name
    return ""


class CompiledFilter:
    """The compiled code of one estimator.

    Args:
        estimator: the estimator; its class names the template.
        made: the library.
    """

    def __init__(self, estimator: RecursiveEstimator, made: PlantLibrary) -> None:
        system = estimator.system
        self._estimator, self._made = estimator, made
        self._sizes = system.nx, system.ny, system.nu
        samples = estimator.noise.samples
        self._by_sample = samples is not None
        # The number of rows that model and noise have, 1 if they are the same for any number
        shapes = [np.shape(getattr(system, name)) for name in made.numbers]
        told = () if samples is None else samples.std.shape[:1]
        self._rows = np.broadcast_shapes((1,), told, *shapes)[0]
        self._plan = self._planned(estimator, estimator.noise.R(0.0)[None])
        self._layouts: dict[int, _Layout] = {}
        self._run, self._update = made.code.run, made.code.update
        self._run.argtypes = [ctypes.c_void_p] * 2
        self._update.argtypes = [
            *(ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64, ctypes.c_double),
            *[ctypes.c_void_p] * 5,
        ]
        self._run.restype = self._update.restype = ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        batch = len(state.xhat)
        layout = self._layouts.get(batch) or self._layout(batch)
        if state.P is None or self._rows not in (1, batch):
            return None
        before = state.packed
        if type(before) is not layout.buffer:
            before = self._packed(state, layout)
        # All arrays of the next state are parts of one buffer, whose address is found once.
        buffer = layout.buffer()
        plan = self._plan
        if self._by_sample:
            plan = plan.with_R(self._estimator.noise.R(t)[None])
        memory, arrays = self._estimator.carried_memory(state)
        more = _call_with(arrays) if arrays else None
        left = self._update(
            addressof(plan.structure),
            batch,
            state.t is None,
            t,
            _contiguous(y),
            _contiguous(u) if self._sizes[2] else None,
            addressof(buffer),
            addressof(before),
            addressof(more) if more else None,
        )
        x, P, innovation, S = [
            np.ndarray(shape, _DOUBLE, buffer, place, strides)
            for shape, place, strides in layout.views
        ]
        # The attributes are set at once, in a quarter of the time that State(...) takes.
        after = object.__new__(State)
        after.__dict__.update(
            xhat=x, t=t, u=u, P=P, innovation=innovation, S=S, memory=memory, root=state.root
        )
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

    def run(self, record: Record) -> Estimates | None:
        """Return the estimates of a record; None if NumPy has to process it."""
        state = self._estimator.reset(record.prior)
        batch, n, (nx, ny, _) = record.batch, record.num_samples, self._sizes
        rooted = np.zeros(batch, dtype=bool)
        if state.root is not None:
            rooted[carried(state.root)] = True
        if self._rows not in (1, batch) or rooted.all():
            return None
        shapes = {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}
        results = _empty({name: (n, *shapes[name], batch) for name in _FIELDS})
        # For each row, the number of the sample that NumPy has to process, n if there is none
        reached = np.where(rooted, 0, n)
        state = self._through(record, np.flatnonzero(~rooted), 0, state, results, reached)
        while (k := int(reached.min())) < n:
            rows = np.flatnonzero(reached == k)
            state = self._by_numpy(record, rows, k, state, results)
            reached[rows] = k + 1
            rows = rows[~np.isin(rows, () if state.root is None else carried(state.root))]
            if k + 1 < n and len(rows):
                state = self._through(record, rows, k + 1, state, results, reached)
        return Estimates(**{name: np.moveaxis(array, -1, 0) for name, array in results.items()})

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
        estimator = self._of_rows(rows)
        assert after.t is not None
        assert after.u is not None
        own = self._state_of(estimator, state, rows)
        part = estimator.update_by_numpy(
            own, after.t, np.asarray(y)[rows], np.asarray(after.u)[rows]
        )
        for name in _FIELDS:
            getattr(after, name)[rows] = getattr(part, name)
        return self._with_rows(after, rows, part)

    def _with_rows(self, state: State, rows: np.ndarray, part: State) -> State:
        """Return the state with the memory and the roots of some rows replaced."""
        root = state.root
        if root is not None and part.root is not None:
            root = root.copy()
            root[rows] = part.root
        memory = self._estimator.with_memory_rows(state.memory, rows, part.memory)
        return replace(state, memory=memory, root=root)

    def _state_of(self, estimator: RecursiveEstimator, state: State, rows: np.ndarray) -> State:
        """Return the state of some rows, for the estimator of these."""
        assert state.P is not None
        return State(
            state.xhat[rows],
            state.t,
            None if state.u is None else np.asarray(state.u)[rows],
            state.P[rows],
            memory=estimator.memory_rows(state.memory, rows),
            root=None if state.root is None else state.root[rows],
        )

    def _through(
        self,
        record: Record,
        rows: np.ndarray,
        first: int,
        state: State,
        results: dict[str, np.ndarray],
        reached: np.ndarray,
    ) -> State:
        """Filter rows of a record from a sample on. Set their estimates (num_samples, ..., batch),
        and the numbers of the samples that NumPy has to process. Return the state with the memory
        that follows in these rows.

        Args:
            record: the record.
            rows: the numbers of the rows.
            first: number of the first sample.
            state: the state before the first sample of the record, with the memory and the roots
                before this one.
            results: the arrays of the results.
            reached: the numbers of the samples, shape (batch,).
        """
        whole, n = len(rows) == record.batch, record.num_samples
        estimator = self._estimator if whole else self._of_rows(rows)
        own = record if whole else record.rows(rows)
        before = self._state_of(estimator, self._before(record, first, state, results), rows)
        memory, arrays = estimator.carried_memory(before)
        plan = self._plan
        if self._by_sample or not whole:
            R = estimator.noise.R(0.0)[None]
            if self._by_sample:
                each = [estimator.noise.R(float(t)) for t in own.t[first:]]
                R = np.stack(np.broadcast_arrays(*each))
            plan = self._planned(estimator, R)
        t = np.ascontiguousarray(own.t[first:], dtype=float)
        y, u = (np.ascontiguousarray(a[:, first:].transpose(1, 2, 0)) for a in (own.y, own.u))
        part = {name: array[first:] for name, array in results.items()}
        if not whole:
            part = {name: np.empty((*a.shape[:-1], len(rows))) for name, a in part.items()}
        earlier = _arrays_of(before)
        names = ["t", "y", "u", "x", "P", "innovation", "S", "x_before", "P_before"]
        given = [t, y, u, *part.values(), *earlier[2:]]
        if before.t is not None:
            names, given = [*names, "t_before", "u_before"], [*given, *earlier[:2]]
        call = _call_with(arrays | dict(zip(names, given, strict=True)))
        call.plan, call.batch, call.samples = addressof(plan.structure), len(rows), n - first
        stopped = np.empty(len(rows), dtype=np.int64)
        self._run(addressof(call), address(stopped))
        reached[rows] = first + stopped
        if whole:
            return replace(state, memory=memory)
        for name, array in part.items():
            results[name][first:, ..., rows] = array
        return replace(state, memory=self._estimator.with_memory_rows(state.memory, rows, memory))

    def _before(
        self, record: Record, k: int, state: State, results: dict[str, np.ndarray]
    ) -> State:
        """Return the state before sample k; the arguments are those of `_through`."""
        if k == 0:
            return state
        xhat, P = (np.moveaxis(results[name][k - 1], -1, 0) for name in ("xhat", "P"))
        return replace(state, t=float(record.t[k - 1]), u=record.u[:, k - 1], xhat=xhat, P=P)

    def _by_numpy(
        self, record: Record, rows: np.ndarray, k: int, state: State, results: dict[str, np.ndarray]
    ) -> State:
        """Process sample k in some rows of a record, and return the state with the memory and the
        roots that follow; the arguments are those of `_through`."""
        estimator = self._of_rows(rows)
        before = self._state_of(estimator, self._before(record, k, state, results), rows)
        t, y, u = float(record.t[k]), record.y[rows, k], record.u[rows, k]
        with np.errstate(all="ignore"):
            part = estimator.update_by_numpy(before, t, y, u)
        if (box := estimator.system.state_box) is not None:
            part = kept_inside(part, box)
        for name in _FIELDS:
            results[name][k][..., rows] = np.moveaxis(getattr(part, name), 0, -1)
        return self._with_rows(state, rows, part)

    def _of_rows(self, rows: np.ndarray) -> RecursiveEstimator:
        """Return the estimator of some rows of the batch."""
        system, level = rows_of(self._estimator.system, rows), self._estimator.noise_std
        if system is self._estimator.system and not isinstance(level, SampledLevel):
            return self._estimator
        if isinstance(level, SampledLevel):
            level = level.rows(rows)
        return replace(self._estimator, system=system, noise_std=level)

    def _planned(self, estimator: RecursiveEstimator, R: np.ndarray) -> Plan:
        """Return the plan of an estimator with the output noise R (samples or 1, ny, ny, batch or
        1)."""
        L = estimator.noise.L(0.0)[..., 0]
        plan = Plan.of(estimator.system, self._made.numbers, L, R)
        plan.set(**estimator.plan_settings())
        return plan

    def _layout(self, batch: int) -> _Layout:
        """Return the layout of a buffer for a batch."""
        nx, ny, nu = self._sizes
        shapes = [(nx,), (nx, nx), (ny,), (ny, ny)]
        sizes = [1, ny * batch, nu * batch, *(batch * int(np.prod(shape)) for shape in shapes)]
        ends = [8 * int(end) for end in np.cumsum(sizes)]
        views = []
        for shape, place in zip(shapes, ends[2:], strict=False):
            array = np.moveaxis(np.empty((*shape, batch)), -1, 0)
            views.append((array.shape, place, array.strides))
        kind = ctypes.c_double * (ends[-1] // 8 + batch)
        buffer = type("Packed", (kind,), {"__reduce__": _left_behind})
        layout = _Layout(buffer, ends[1], tuple(views), ends[-1])
        if len(self._layouts) < _LAYOUTS:
            self._layouts[batch] = layout
        return layout

    def _packed(self, state: State, layout: _Layout) -> Any:
        """Return the arrays of a state in a buffer."""
        buffer, nu = layout.buffer(), self._sizes[2]
        if state.t is not None:
            buffer[0] = state.t
        if state.u is not None and nu:
            np.ndarray((nu, len(state.xhat)), _DOUBLE, buffer, layout.u)[:] = np.asarray(state.u).T
        for value, (shape, place, strides) in zip(
            (state.xhat, state.P), layout.views, strict=False
        ):
            np.ndarray(shape, _DOUBLE, buffer, place, strides)[:] = value
        return buffer


def _left_behind(self: Any) -> tuple[Any, ...]:
    """Return what is copied or pickled in place of a buffer: None, because its address holds in its
    own place and process only."""
    return type(None), ()


def _contiguous(array: np.ndarray) -> bytes:
    """Return the numbers of an array (batch, n) with the batch last."""
    if getattr(array, "dtype", None) is not _DOUBLE:
        array = np.asarray(array, dtype=float)
    return array.T.tobytes()


def _empty(shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Return empty arrays of some shapes. They are views of a single one, because only large arrays
    are allocated in large memory pages, whose first access takes less time."""
    sizes = [math.prod(shape) for shape in shapes.values()]
    parts = np.split(np.empty(sum(sizes)), np.cumsum(sizes)[:-1])
    return {name: part.reshape(shapes[name]) for name, part in zip(shapes, parts, strict=True)}


def _call_with(arrays: dict[str, np.ndarray]) -> CallStructure:
    """Return a call with the arrays of some fields."""
    return CallStructure(**{name: address(array) for name, array in arrays.items()})


def _arrays_of(state: State) -> list[np.ndarray]:
    """Return the time, inputs, estimate and covariance of a state in the layout of compiled
    code."""
    assert state.P is not None
    t = np.array([np.nan if state.t is None else state.t])
    u = np.empty((0, len(state.xhat))) if state.u is None else state.u.T
    parts = (t, u, state.xhat.T, state.P.transpose(1, 2, 0))
    return [np.ascontiguousarray(part, dtype=float) for part in parts]
