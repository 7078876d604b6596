"""Moving windows in compiled code; see `pinnobs_gym.estimation.compiled`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from math import prod
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
from pinnobs_gym.estimation.moving_window import MovingWindow
from pinnobs_gym.estimation.window_samples import WindowSamples
from pinnobs_gym.simulation.kernels.calls import address
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.record import check_use

_SHAPES = ("mean_after", "P_after", "start_after", "x", "P_x", "innovation", "S")
"""The results, in the order of their places in one array."""
_FIELDS = ("xhat", "P", "innovation", "S")


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
    all_states = estimator.noise.told.stochastic
    made = library_of(estimator, "moving_window" if all_states else "")
    if isinstance(made, str):
        return made
    return (CompiledMovingWindow if all_states else CompiledExactWindow)(estimator, made)


class CompiledWindow:
    """The compiled code of one estimator.

    Args:
        estimator: the estimator; its class names the template.
        made: the library.
    """

    def __init__(self, estimator: Any, made: PlantLibrary) -> None:
        system = estimator.system
        self.estimator = estimator
        self.sizes = system.nx, system.ny, system.nu
        self._by_sample = estimator.noise.samples is not None
        self._rows = rows_of_numbers(estimator, made)
        self._plan = plan_of(estimator, made, estimator.noise.R(0.0)[None])
        self._slide = made.code.slide
        self._slide.argtypes = [ctypes.c_void_p]
        self._slide.restype = ctypes.c_int64

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        """Return the state after a sample; None if NumPy has to process it. The arguments are those
        of `Estimator.update`."""
        raise NotImplementedError

    def fits(self, batch: int) -> bool:
        """Return whether the parameters and the noise of the model fit a batch of this size: there
        is one of each for all rows, or one for each row."""
        return self._rows in (1, batch)

    def slide(
        self, samples: WindowSamples, before: Sequence[np.ndarray], start_after: tuple[int, ...]
    ) -> tuple[list[np.ndarray], WindowSamples, np.ndarray]:
        """Take the last of some samples into windows.

        Args:
            samples: the samples, with the new one.
            before: the mean and the covariance at the start of the windows, and where the start of
                each search lies, with the batch last.
            start_after: shape of the field ``start_after`` without the batch.

        Returns:
            The results in the order of the fields, with the batch last, the samples of the windows
            after it, and the numbers of the rows that are left to NumPy.
        """
        batch, (nx, ny, _) = samples.y.shape[-1], self.sizes
        plan = self._plan
        if self._by_sample:
            plan = plan.with_R(noise_at(self.estimator.noise, samples.t))
        shapes = ((nx,), (nx, nx), start_after, (nx,), (nx, nx), (ny,), (ny, ny), (1,))
        ends = list(accumulate(batch * prod(shape) for shape in shapes))
        places = [0, *ends[:-1]]
        results = np.empty(ends[-1])
        begin, kept = address(results), [np.ascontiguousarray(array) for array in before]
        call = _WindowStructure(
            ctypes.addressof(plan.structure),
            *(batch, len(samples), self.estimator.window, self.estimator.steps),
            *(address(array) for array in (samples.t, samples.y, samples.u, *kept)),
            *(begin + 8 * place for place in places),
        )
        left = self._slide(ctypes.addressof(call))
        *parts, marks = (
            results[place:end].reshape(*shape, batch)
            for place, end, shape in zip(places, ends, shapes, strict=True)
        )
        rows = np.flatnonzero(marks.view(np.int64)) if left else np.arange(0)
        if len(samples) > self.estimator.window:
            samples = samples.without_first()
        return parts, samples, rows

    def state(
        self, sample: tuple[float, np.ndarray, np.ndarray], parts: Sequence[np.ndarray], memory: Any
    ) -> State:
        """Return the state after a sample (t in s, y and u with the batch first), given the
        estimate, its covariance, the innovation and its covariance, with the batch last, and the
        memory."""
        x, P, e, S = parts
        t, _, u = sample
        return State(x.T, t, u, P.transpose(2, 0, 1), e.T, S.transpose(2, 0, 1), memory)

    def by_numpy(
        self,
        after: State,
        sample: tuple[float, np.ndarray, np.ndarray],
        rows: np.ndarray,
        memory: Any,
    ) -> State:
        """Process a sample in NumPy for some rows, and set these rows in the state after it.

        Args:
            after: the state after the sample, of all rows; it is changed.
            sample: t in s, and y and u of all rows.
            rows: numbers of the rows.
            memory: the memory before the sample, of these rows.

        Returns:
            The state after the sample, of these rows.
        """
        t, y, u = sample
        if self.sizes[2]:  # the inputs may be others than the model uses
            check_use(self.estimator.system, np.array([t], dtype=float), np.asarray(u)[:, None])
        estimator = of_rows(self.estimator, rows)
        part = estimator.by_numpy(memory, t, np.asarray(y)[rows], np.asarray(u)[rows])
        for name in _FIELDS:
            getattr(after, name)[rows] = getattr(part, name)
        return part


class CompiledExactWindow(CompiledWindow):
    """The compiled code for windows whose states follow from their first one."""

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        window: ExactWindow | None = state.memory.exact
        if window is None or not self.fits(len(window.arrival)):
            return None
        before = window.arrival.T, window.P, window.start.T
        samples = window.samples.extended(t, y, u)
        (mean, P, start, *parts), samples, rows = self.slide(samples, before, self.sizes[:1])
        own = ExactWindow(mean.T, P, start.T, samples)
        after = self.state((t, y, u), parts, replace(state.memory, exact=own))
        if len(rows):
            memory = replace(state.memory, exact=window.rows(rows))
            part: ExactWindow = self.by_numpy(after, (t, y, u), rows, memory).memory.exact
            own.arrival[rows], own.start[rows] = part.arrival, part.start
            own.P[..., rows] = part.P
        return after


class CompiledMovingWindow(CompiledWindow):
    """The compiled code for windows whose states are all unknown."""

    def update(self, state: State, t: float, y: np.ndarray, u: np.ndarray) -> State | None:
        window: MovingWindow = state.memory.whole
        # Rows with very wide priors lose digits in any other order of operations.
        wide, batch = state.memory.rows, len(window.mean)
        if not self.fits(batch) or (batch and len(wide) == batch):
            return None
        before = window.mean.T, window.root.transpose(1, 2, 0), window.x.transpose(0, 2, 1)
        samples = window.samples.extended(t, y, u)
        shape = min(len(samples), self.estimator.window), self.sizes[0]
        (mean, L, x, *parts), samples, rows = self.slide(samples, before, shape)
        own = MovingWindow(mean.T, L.transpose(2, 0, 1), x.transpose(0, 2, 1), False, samples)
        after = self.state((t, y, u), parts, replace(state.memory, whole=own))
        if len(wide):
            rows = np.union1d(rows, wide)
        if len(rows):
            memory = replace(state.memory, whole=window.rows(rows))
            part: MovingWindow = self.by_numpy(after, (t, y, u), rows, memory).memory.whole
            own.mean[rows], own.root[rows], own.x[:, rows] = part.mean, part.root, part.x
        return after
