"""Filters in compiled code over whole records; see `pinnobs_gym.estimation.compiled`."""

from __future__ import annotations

import ctypes
import math
from ctypes import addressof
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from pinnobs_gym.estimation.compiled_code import noise_at, of_rows, plan_of, rows_of_numbers
from pinnobs_gym.estimation.estimator import Estimates, State
from pinnobs_gym.estimation.projection import kept_inside
from pinnobs_gym.estimation.square_root import carried
from pinnobs_gym.simulation.kernels.calls import CallStructure, Plan, address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import Record

if TYPE_CHECKING:
    from pinnobs_gym.estimation.recursive import RecursiveEstimator


class CompiledRun:
    """The compiled code of one estimator for whole records.

    Args:
        estimator: the estimator; its class names the template.
        made: the library.
        plan: the estimator's plan.
    """

    def __init__(self, estimator: RecursiveEstimator, made: PlantLibrary, plan: Plan) -> None:
        self._estimator, self._made, self._plan = estimator, made, plan
        self._by_sample = estimator.noise.samples is not None
        self._rows = rows_of_numbers(estimator, made)
        self._run = made.code.run
        self._run.argtypes = [ctypes.c_void_p] * 2
        self._run.restype = ctypes.c_int64

    def __call__(self, record: Record) -> Estimates | None:
        """Return the estimates of a record; None if NumPy has to process it."""
        state = self._estimator.reset(record.prior)
        batch, n, system = record.batch, record.num_samples, self._estimator.system
        nx, ny = system.nx, system.ny
        rooted = np.zeros(batch, dtype=bool)
        if state.root is not None:
            rooted[carried(state.root)] = True
        if self._rows not in (1, batch) or rooted.all():
            return None
        shapes = {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}
        results = _empty({name: (n, *shapes[name], batch) for name in self._estimator.computes})
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
        return Estimates(**{name: _batch_first(array) for name, array in results.items()})

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
        estimator = self._estimator if whole else of_rows(self._estimator, rows)
        own = record if whole else record.rows(rows)
        before = self._before(record, first, state, results)
        before = before if whole else state_of(estimator, before, rows)
        memory, arrays = estimator.carried_memory(before.memory)
        plan = self._plan
        if self._by_sample or not whole:
            R = noise_at(estimator.noise, own.t[first:])
            plan = plan_of(estimator, self._made, R, **estimator.plan_settings())
        t = np.ascontiguousarray(own.t[first:], dtype=float)
        y, u = (np.ascontiguousarray(a[:, first:].transpose(1, 2, 0)) for a in (own.y, own.u))
        part = {name: array[first:] for name, array in results.items()}
        if not whole:
            part = {name: np.empty((*a.shape[:-1], len(rows))) for name, a in part.items()}
        earlier = _arrays_of(before)
        part["x"] = part.pop("xhat")
        given = {"t": t, "y": y, "u": u, **part, **earlier}
        call = call_with(arrays | given)
        call.plan, call.batch, call.samples = addressof(plan.structure), len(rows), n - first
        stopped = np.empty(len(rows), dtype=np.int64)
        self._run(addressof(call), address(stopped))
        reached[rows] = first + stopped
        if whole:
            return replace(state, memory=memory)
        part["xhat"] = part.pop("x")
        for name, array in part.items():
            results[name][first:, ..., rows] = array
        return replace(state, memory=self._estimator.with_memory_rows(state.memory, rows, memory))

    def _before(
        self, record: Record, k: int, state: State, results: dict[str, np.ndarray]
    ) -> State:
        """Return the state before sample k; the arguments are those of `_through`."""
        if k == 0:
            return state
        moments = {n: _batch_first(results[n][k - 1]) for n in ("xhat", "P") if n in results}
        return replace(state, t=float(record.t[k - 1]), u=record.u[:, k - 1], **moments)

    def _by_numpy(
        self, record: Record, rows: np.ndarray, k: int, state: State, results: dict[str, np.ndarray]
    ) -> State:
        """Process sample k in some rows of a record, and return the state with the memory and the
        roots that follow; the arguments are those of `_through`."""
        estimator = of_rows(self._estimator, rows)
        before = state_of(estimator, self._before(record, k, state, results), rows)
        t, y, u = float(record.t[k]), record.y[rows, k], record.u[rows, k]
        with np.errstate(all="ignore"):
            part = estimator.update_by_numpy(before, t, y, u)
        if (box := estimator.system.state_box) is not None:
            part = kept_inside(part, box)
        for name in self._estimator.computes:
            results[name][k][..., rows] = np.moveaxis(getattr(part, name), 0, -1)
        return with_rows(self._estimator, state, rows, part)


def state_of(estimator: RecursiveEstimator, state: State, rows: np.ndarray) -> State:
    """Return the state of some rows, for the estimator of these."""
    return State(
        state.xhat[rows],
        state.t,
        None if state.u is None else np.asarray(state.u)[rows],
        None if state.P is None else state.P[rows],
        memory=estimator.memory_rows(state.memory, rows),
        root=None if state.root is None else state.root[rows],
    )


def with_rows(estimator: RecursiveEstimator, state: State, rows: np.ndarray, part: State) -> State:
    """Return the state with the memory and the roots of some rows replaced."""
    root = state.root
    if root is not None and part.root is not None:
        root = root.copy()
        root[rows] = part.root
    memory = estimator.with_memory_rows(state.memory, rows, part.memory)
    return replace(state, memory=memory, root=root)


def _empty(shapes: dict[str, tuple[int, ...]]) -> dict[str, np.ndarray]:
    """Return empty arrays of some shapes. They are views of a single one, because only large arrays
    are allocated in large memory pages, whose first access takes less time."""
    buffer, views, end = np.empty(sum(map(math.prod, shapes.values()))), {}, 0
    for name, shape in shapes.items():
        start, end = end, end + math.prod(shape)
        views[name] = buffer[start:end].reshape(shape)
    return views


def _batch_first(array: np.ndarray) -> np.ndarray:
    """Return an array (..., batch) as one of shape (batch, ...)."""
    last = array.ndim - 1
    return array.transpose(last, *range(last))


def call_with(arrays: dict[str, np.ndarray]) -> CallStructure:
    """Return a call with the arrays of some fields."""
    return CallStructure(**{name: address(array) for name, array in arrays.items()})


def _arrays_of(state: State) -> dict[str, np.ndarray]:
    """Return the time, inputs, estimate and covariance of a state in the layout of compiled code,
    by the fields of ``struct call``; the first two only after a sample."""
    arrays = {"x_before": state.xhat.T}
    if state.P is not None:
        arrays["P_before"] = state.P.transpose(1, 2, 0)
    if state.t is not None:
        u = np.empty((0, len(state.xhat))) if state.u is None else state.u.T
        arrays |= {"t_before": np.array([state.t]), "u_before": u}
    return {name: np.ascontiguousarray(array, dtype=float) for name, array in arrays.items()}
