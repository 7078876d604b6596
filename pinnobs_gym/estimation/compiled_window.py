"""Moving windows in compiled code; see `pinnobs_gym.estimation.compiled`."""

from __future__ import annotations

import ctypes
from dataclasses import replace
from typing import Any

import numpy as np

from pinnobs_gym.estimation.compiled_code import (
    library_of,
    noise_at,
    of_rows,
    plan_of,
    rows_of_numbers,
)
from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.exact_window import ExactWindow
from pinnobs_gym.simulation.kernels.calls import address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import check_use

_SHAPES = ("mean_after", "P_after", "start_after", "x", "P_x", "innovation", "S")
"""The results, in the order of their places in one array."""


class _WindowStructure(ctypes.Structure):
    """``struct window`` of ``window.h``."""

    _fields_ = [
        ("plan", ctypes.c_void_p),
        *((name, ctypes.c_int64) for name in ("batch", "samples", "most", "rounds")),
        *((name, ctypes.c_void_p) for name in ("t", "y", "u", "mean", "P", "start", *_SHAPES)),
        ("left", ctypes.c_void_p),
    ]


def compiled_window(estimator: Any) -> CompiledWindow | str:
    """Return the compiled code of an estimator, a `pinnobs_gym.estimators.mhe.MHE`, or the reason
    in one line why there is none."""
    if estimator.noise.told.stochastic:
        return "its windows have process noise"
    made = library_of(estimator)
    return made if isinstance(made, str) else CompiledWindow(estimator, made)


class CompiledWindow:
    """The compiled code of one estimator, for windows whose states follow from their first one.

    Args:
        estimator: the estimator; its class names the template.
        made: the library.
    """

    def __init__(self, estimator: Any, made: PlantLibrary) -> None:
        system = estimator.system
        self._estimator = estimator
        self._sizes = system.nx, system.ny, system.nu
        self._by_sample = estimator.noise.samples is not None
        self._rows = rows_of_numbers(estimator, made)
        self._plan = plan_of(estimator, made, estimator.noise.R(0.0)[None])
        self._slide = made.code.slide
        self._slide.argtypes = [ctypes.c_void_p]
        self._slide.restype = ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        window: ExactWindow = state.memory.exact
        batch, (nx, ny, _) = len(window.arrival), self._sizes
        if self._rows not in (1, batch):
            return None
        times, outputs, inputs = window.with_sample(t, y, u)
        plan = self._plan
        if self._by_sample:
            plan = plan.with_R(noise_at(self._estimator.noise, times))
        sizes = np.cumsum([0, nx, nx * nx, nx, nx, nx * nx, ny, ny * ny, 1]) * batch
        results = np.empty(sizes[-1])
        begin, before = address(results), (window.arrival.T, window.P, window.start.T)
        kept = [np.ascontiguousarray(array) for array in before]
        call = _WindowStructure(
            ctypes.addressof(plan.structure),
            *(batch, len(times), self._estimator.window, self._estimator.steps),
            *(address(array) for array in (times, outputs, inputs, *kept)),
            *(begin + 8 * int(size) for size in sizes[:-1]),
        )
        left = self._slide(ctypes.addressof(call))
        shapes = ((nx,), (nx, nx), (nx,), (nx,), (nx, nx), (ny,), (ny, ny))
        mean, P_bar, start, x, P, e, S = (
            results[sizes[i] : sizes[i + 1]].reshape(*shape, batch)
            for i, shape in enumerate(shapes)
        )
        first = int(len(times) > self._estimator.window)
        samples = times[first:], outputs[first:], inputs[first:]
        after = State(
            x.T,
            t,
            u,
            P.transpose(2, 0, 1),
            e.T,
            S.transpose(2, 0, 1),
            replace(state.memory, exact=ExactWindow(mean.T, P_bar, start.T, *samples)),
        )
        if left:
            rows = np.flatnonzero(results[sizes[-2] :].view(np.int64))
            return self._completed(state, after, (t, y, u), rows)
        return after

    def _completed(
        self,
        state: State,
        after: State,
        sample: tuple[float, np.ndarray, np.ndarray],
        rows: np.ndarray,
    ) -> State:
        """Return the state after a sample, with the rows that are left to NumPy."""
        t, y, u = sample
        if self._sizes[2]:  # the inputs may be others than the model uses
            check_use(self._estimator.system, np.array([t], dtype=float), np.asarray(u)[:, None])
        before: ExactWindow = state.memory.exact
        own = replace(state, memory=replace(state.memory, exact=before.rows(rows)))
        estimator = of_rows(self._estimator, rows)
        part = estimator.by_first_state(own.memory, t, np.asarray(y)[rows], np.asarray(u)[rows])
        for name in ("xhat", "P", "innovation", "S"):
            getattr(after, name)[rows] = getattr(part, name)
        window: ExactWindow = after.memory.exact
        own_window: ExactWindow = part.memory.exact
        window.arrival[rows], window.start[rows] = own_window.arrival, own_window.start
        window.P[..., rows] = own_window.P
        return after
