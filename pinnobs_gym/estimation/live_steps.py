"""How a live filter moves from one sample to the next: by its `Estimator.update`, or in compiled
code, whose results become arrays when they are read."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from struct import Struct
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pinnobs_gym.estimation.compiled import CompiledFilter
from pinnobs_gym.estimation.compiled_layout import Layout
from pinnobs_gym.estimation.compiled_run import call_with
from pinnobs_gym.estimation.estimator import Estimator, State
from pinnobs_gym.estimation.live_sample import Sample
from pinnobs_gym.estimation.recursive import RecursiveEstimator


class Moments(NamedTuple):
    """What is told of the estimate of one plant; None for what the estimator does not compute."""

    xhat: list[float]
    """Estimate (nx,)."""
    variances: list[float] | None
    """Diagonal of its covariance, (nx,)."""
    innovation: list[float] | None
    """Innovation (ny,)."""
    S: list[float] | None
    """Covariance of the innovation, (ny·ny,)."""


class Packed:
    """The state of a filter of one plant in the buffer of compiled code; see
    `pinnobs_gym.estimation.compiled`.

    Args:
        layout: the places of its arrays in the buffer.
        buffer: the buffer.
        t: time of the sample in s.
        memory: as in `State`.
    """

    __slots__ = ("_layout", "buffer", "memory", "t")

    def __init__(self, layout: Layout, buffer: Any, t: float, memory: Any) -> None:
        self._layout, self.buffer, self.t, self.memory = layout, buffer, t, memory

    def moments(self) -> Moments:
        """Return the moments; parts of the buffer become lists faster than arrays."""
        buffer, places = self.buffer, self._layout.places
        parts = {name: buffer[place] for name, place in places.items()}
        x, P = parts["xhat"], parts.get("P")
        variances = None if P is None else P[:: len(x) + 1]
        return Moments(x, variances, parts.get("innovation"), parts.get("S"))

    def state(self) -> State:
        """Return the same as a `State`, whose arrays are views of the buffer."""
        arrays, u = self._layout.arrays(self.buffer), self._layout.inputs(self.buffer)
        after = State(t=self.t, u=u, memory=self.memory, **arrays)
        object.__setattr__(after, "packed", self.buffer)
        return after


Point: TypeAlias = State | Packed
"""What a filter knows after a sample."""
Steps: TypeAlias = Callable[[Any, Sample], Point]
"""A function of the point before a sample and the sample, which returns the point after it."""


def state_of(point: Point) -> State:
    """Return a point as a `State`."""
    return point.state() if isinstance(point, Packed) else point


Arrays: TypeAlias = tuple[np.ndarray, np.ndarray | None, np.ndarray | None, np.ndarray | None]
"""The estimate (1, nx), its covariance, the innovation and its covariance."""


def arrays_of(state: State) -> Arrays:
    """Return the moments of a state as arrays."""
    return state.xhat, state.P, state.innovation, state.S


def moments_of(
    xhat: np.ndarray, P: np.ndarray | None, innovation: np.ndarray | None, S: np.ndarray | None
) -> Moments:
    """Return the moments in arrays; see `arrays_of`."""
    return Moments(
        np.asarray(xhat)[0].tolist(),
        None if P is None else np.diagonal(np.asarray(P)[0]).tolist(),
        None if innovation is None else np.asarray(innovation)[0].tolist(),
        None if S is None else np.asarray(S)[0].ravel().tolist(),
    )


def steps_of(estimator: Estimator) -> Steps:
    """Return the fastest way of an estimator through samples of one plant."""
    plain = ByUpdate(estimator)
    if isinstance(estimator, RecursiveEstimator) and estimator.noise.samples is None:
        compiled = estimator.compiled
        if isinstance(compiled, CompiledFilter):
            return InBuffers(compiled, estimator, plain)
    return plain


class ByUpdate:
    """Steps by `Estimator.update`.

    Args:
        estimator: the estimator.
    """

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator

    def __call__(self, before: Point, sample: Sample) -> State:
        """Return the state after a sample.

        Raises:
            ValueError: in one line, if the model cannot use the sample.
        """
        with np.errstate(all="ignore"):  # a diverged estimate is marked by values not finite
            return self.estimator.update(state_of(before), *self._arrays(sample))

    def _arrays(self, sample: Sample) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the time, the outputs (1, ny) and the inputs (1, nu) of a sample."""
        t, y, u = sample
        given = self.estimator.system.input(np.array([t])) if u is None else [u]
        return t, np.array([y], dtype=float), np.array(given, dtype=float)


class ByNumpy(ByUpdate):
    """Steps in NumPy of an estimator that has compiled code."""

    def __call__(self, before: Point, sample: Sample) -> State:
        estimator = self.estimator
        assert isinstance(estimator, RecursiveEstimator)
        with np.errstate(all="ignore"):
            return estimator.update_by_numpy(state_of(before), *self._arrays(sample))


class InBuffers:
    """Steps in compiled code.

    Args:
        compiled: the code.
        estimator: its estimator.
        plain: the steps that it leaves to NumPy.
    """

    def __init__(
        self, compiled: CompiledFilter, estimator: RecursiveEstimator, plain: ByUpdate
    ) -> None:
        system, self._carried_memory = estimator.system, estimator.carried_memory
        self._plain, self._code = plain, compiled.code
        self._layout = compiled.layout(1)
        self._buffer = self._layout.buffer
        self._plan = ctypes.addressof(compiled.plan.structure)
        self._y, self._u = (Struct(f"{size}d").pack for size in (system.ny, system.nu))

    def __call__(self, before: Point, sample: Sample) -> Point:
        """Return the point after a sample; see `ByUpdate`."""
        t, y, u = sample
        if isinstance(before, Packed):
            earlier = before.buffer
        elif before.root is not None or (before.P is None and "P" in self._layout.places):
            return self._plain(before, sample)
        else:
            earlier = self._layout.packed(before.t, before.u, before.xhat, before.P)
        buffer = self._buffer()
        memory, arrays = self._carried_memory(before.memory)
        more = call_with(arrays) if arrays else None
        left = self._code(
            self._plan,
            1,
            before.t is None,
            t,
            self._y(*y),
            self._u(*u) if u else None,
            ctypes.addressof(buffer),
            ctypes.addressof(earlier),
            ctypes.addressof(more) if more else None,
        )
        if left:
            return self._plain(before, sample)
        return Packed(self._layout, buffer, t, memory)
