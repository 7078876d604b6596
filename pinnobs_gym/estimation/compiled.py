"""Filters in compiled code, for estimators whose class names a template.

The code in NumPy stays the reference. A sample that the compiled code leaves to it, because a state
is beyond its bounds or a matrix has no root, is processed in NumPy, in the rows concerned.
"""

from __future__ import annotations

import ctypes
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pinnobs_gym.simulation.kernels.calls import CallStructure, Plan, address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary, plant_library
from pinnobs_gym.simulation.noise import AssumedNoise, Noise, SampledLevel
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.truth import rows_of

if TYPE_CHECKING:
    from pinnobs_gym.estimation.estimator import State
    from pinnobs_gym.estimation.recursive import RecursiveEstimator

FIELDS = ("xhat", "P", "innovation", "S")
"""The fields of `Estimates` that compiled filters compute."""


class Packed(NamedTuple):
    """The arrays of a `State` in one buffer, in the layout of compiled code."""

    start: int
    """Address of the buffer."""
    buffer: np.ndarray
    """The buffer, which has to live as long as its address is used."""
    xhat: np.ndarray
    """The state's estimate, a view of the buffer; a state with another one is not packed."""
    P: np.ndarray


def compiled_filter(estimator: RecursiveEstimator) -> CompiledFilter | str:
    """Return the compiled code of an estimator, or the reason in one line why there is none."""
    template = estimator.template
    if not template:
        return f"{type(estimator).__name__} has no compiled code"
    owner = next(cls for cls in type(estimator).__mro__ if "template" in vars(cls))
    for name in ("reset", "predict", "correct"):
        if getattr(type(estimator), name) is not getattr(owner, name):
            return f"{type(estimator).__name__} defines {name}"
    noise = estimator.noise
    if type(noise) is not AssumedNoise or type(noise.told) is not Noise:
        return "its noise has methods of its own"
    made = plant_library(estimator.system, template)
    return made if isinstance(made, str) else CompiledFilter(estimator, made)


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
        self._by_sample = estimator.noise.samples is not None
        self._by_row = any(np.ndim(getattr(system, name)) for name in made.numbers)
        self._plan = self._planned(estimator.noise.R(0.0)[None])
        self._at = ctypes.addressof(self._plan.structure)
        self._run = made.code.run
        self._run.restype = ctypes.c_int64
        self._run.argtypes = [ctypes.c_void_p, ctypes.c_void_p]

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        if state.root is not None or state.P is None or self._by_sample:
            return None
        batch, (nx, ny, nu) = len(state.xhat), self._sizes
        # All arrays are parts of one buffer, whose address is found once.
        size, ends, offsets = _layout(nx, ny, nu, batch)
        buffer = np.empty(size)
        start = ctypes.addressof(ctypes.c_double.from_buffer(buffer))
        buffer[0] = t
        buffer[1 : ends[1]].reshape(ny, batch)[:] = y.T
        if nu:
            buffer[ends[1] : ends[2]].reshape(nu, batch)[:] = u.T
        packed, kept = state.packed, None
        if packed is not None and packed.xhat is state.xhat and packed.P is state.P:
            before = packed.start
            earlier = before, before + offsets[2], before + offsets[3], before + offsets[4]
        else:
            kept = _arrays_of(state)
            earlier = tuple(map(address, kept))
        if state.t is None:
            earlier = None, None, *earlier[2:]
        memory, arrays = self._estimator.carried_memory(state)
        call = CallStructure(self._at, batch, 1, *(start + at for at in offsets), *earlier)
        for name, array in arrays.items():
            setattr(call, name, address(array))
        reached = (ctypes.c_int64 * batch)()
        if self._run(ctypes.addressof(call), ctypes.addressof(reached)):
            return None
        x = buffer[ends[2] : ends[3]].reshape(nx, batch).T
        P = buffer[ends[3] : ends[4]].reshape(nx, nx, batch).transpose(2, 0, 1)
        innovation = buffer[ends[4] : ends[5]].reshape(ny, batch).T
        S = buffer[ends[5] :].reshape(ny, ny, batch).transpose(2, 0, 1)
        return type(state)(x, t, u, P, innovation, S, memory, None, Packed(start, buffer, x, P))

    def run(self, record: Record) -> dict[str, np.ndarray] | None:
        """Return the fields of the estimates of a record, (batch, num_samples, ...) each; None if
        NumPy has to process it."""
        state = self._estimator.reset(record.prior)
        if state.root is not None:
            return None
        batch, n, (nx, ny, _) = record.batch, record.num_samples, self._sizes
        shapes = {"xhat": (nx,), "P": (nx, nx), "innovation": (ny,), "S": (ny, ny)}
        results = {name: np.empty((n, *shapes[name], batch)) for name in FIELDS}
        # Rows, the first of their samples that is not done, and their state before it
        waiting = [(np.arange(batch), 0, state)]
        while waiting:
            rows, first, state = waiting.pop()
            own, part = record, results
            if len(rows) < batch:
                own = record.rows(rows)
                part = {name: a[..., rows] for name, a in results.items()}
            memory, reached = self._through(own, rows, first, state, part)
            if part is not results:
                for name, array in part.items():
                    results[name][first:, ..., rows] = array[first:]
            for k in np.unique(reached[reached < n]).tolist():
                chosen = np.flatnonzero(reached == k)
                before = replace(state, memory=memory)
                if k > first:
                    before = replace(
                        before,
                        t=float(own.t[k - 1]),
                        u=own.u[:, k - 1],
                        xhat=np.moveaxis(part["xhat"][k - 1], -1, 0),
                        P=np.moveaxis(part["P"][k - 1], -1, 0),
                    )
                after = self._by_numpy(own, k, before, chosen, rows)
                for name in FIELDS:
                    value = np.moveaxis(getattr(after, name), 0, -1)
                    results[name][k][..., rows[chosen]] = value
                waiting.append((rows[chosen], k + 1, after))
        return {name: np.moveaxis(array, -1, 0) for name, array in results.items()}

    def _through(
        self,
        record: Record,
        rows: np.ndarray,
        first: int,
        state: State,
        results: dict[str, np.ndarray],
    ) -> tuple[Any, np.ndarray]:
        """Filter a record from a sample on, and write the fields (num_samples, ..., batch) of its
        estimates. Return the memory at the end, and the number of the sample that NumPy has to
        process in each row, that of all samples if there is none.

        Args:
            record: the record.
            rows: the numbers of its rows among those of the estimator.
            first: number of the first sample.
            state: the state before that sample.
            results: the arrays of the results.
        """
        batch, n = record.batch, record.num_samples
        memory, arrays = self._estimator.carried_memory(state)
        plan = self._plan
        if self._by_sample or self._by_row:
            estimator = self._of_rows(rows)
            R = estimator.noise.R(0.0)[None]
            if self._by_sample:
                R = np.stack([estimator.noise.R(float(t)) for t in record.t[first:]])
            plan = self._planned(R, estimator)
        y, u = (np.ascontiguousarray(a[:, first:].transpose(1, 2, 0)) for a in (record.y, record.u))
        t = np.ascontiguousarray(record.t[first:], dtype=float)
        fields = [results[name][first:] for name in FIELDS]
        earlier = _arrays_of(state)
        pointers = [address(array) for array in (t, y, u, *fields, *earlier)]
        if state.t is None:
            pointers[-4:-2] = None, None
        at = ctypes.addressof(plan.structure)
        call = CallStructure(at, batch, n - first, *pointers)
        for name, array in arrays.items():
            setattr(call, name, address(array))
        reached = np.empty(batch, dtype=np.int64)
        self._run(ctypes.addressof(call), address(reached))
        return memory, first + reached

    def _by_numpy(
        self, record: Record, k: int, state: State, chosen: np.ndarray, rows: np.ndarray
    ) -> State:
        """Return the state after sample k in the chosen rows of a record, whose rows have the given
        numbers among those of the estimator."""
        estimator = self._of_rows(rows[chosen])
        own = replace(
            state,
            xhat=state.xhat[chosen],
            P=None if state.P is None else state.P[chosen],
            u=None if state.u is None else state.u[chosen],
            innovation=None,
            S=None,
            memory=estimator.memory_rows(state.memory, chosen),
            packed=None,
        )
        t, y, u = float(record.t[k]), record.y[chosen, k], record.u[chosen, k]
        return estimator.update_by_numpy(own, t, y, u)

    def _of_rows(self, rows: np.ndarray) -> RecursiveEstimator:
        """Return the estimator of some rows of the batch."""
        level = self._estimator.noise_std
        if isinstance(level, SampledLevel):
            level = level.rows(rows)
        return replace(
            self._estimator, system=rows_of(self._estimator.system, rows), noise_std=level
        )

    def _planned(self, R: np.ndarray, estimator: RecursiveEstimator | None = None) -> Plan:
        """Return the plan of an estimator, by default the own one, with the output noise R (samples
        or 1, ny, ny, batch or 1)."""
        estimator = self._estimator if estimator is None else estimator
        L = estimator.noise.L(0.0)[..., 0]
        plan = Plan.of(estimator.system, self._made.numbers, L, R)
        plan.set(**estimator.plan_settings())
        return plan


@lru_cache(maxsize=256)
def _layout(nx: int, ny: int, nu: int, batch: int) -> tuple[int, tuple[int, ...], tuple[int, ...]]:
    """Return the number of entries of a buffer with t, y, u, x, P, the innovation and S, the ends
    of all but the last, and the positions of all in bytes."""
    sizes = [1, *(batch * size for size in (ny, nu, nx, nx * nx, ny, ny * ny))]
    ends = np.cumsum(sizes).tolist()
    return ends[-1], tuple(ends[:-1]), tuple(8 * at for at in [0, *ends[:-1]])


def _arrays_of(state: State) -> list[np.ndarray]:
    """Return the time, inputs, estimate and covariance of a state in the layout of compiled
    code."""
    assert state.P is not None
    t = np.array([np.nan if state.t is None else state.t])
    u = np.empty((0, len(state.xhat))) if state.u is None else state.u.T
    parts = (t, u, state.xhat.T, state.P.transpose(1, 2, 0))
    return [np.ascontiguousarray(part, dtype=float) for part in parts]
