"""Steps of the model in compiled code."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import numpy as np

from pinnobs_gym.simulation.kernels.asked import asked_library
from pinnobs_gym.simulation.kernels.calls import address, plant_numbers
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.noise import AssumedNoise, Noise
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import System

_POINTER, _INT, _DOUBLE = ctypes.c_void_p, ctypes.c_int64, ctypes.c_double
_KEPT = "_model_kernel"
"""Key of the kernel among the attributes of a plant."""
_FLOAT = np.dtype(float)
_LARGEST_COUNT = 10**6
"""Largest number of steps between two samples."""


class _Model(ctypes.Structure):
    """``struct model`` of ``model.c``."""

    _fields_ = [
        *(("p", _POINTER), ("p_rows", _INT), ("longest", _DOUBLE), ("breaks", _POINTER)),
        *((name, _INT) for name in ("num_breaks", "input", "discrete")),
    ]


class _Moved(ctypes.Structure):
    """``struct moved`` of ``model.c``."""

    _fields_ = [
        *(("model", _POINTER), ("points", _INT), ("batch", _INT)),
        *(("t0", _DOUBLE), ("t1", _DOUBLE), ("t0_rows", _POINTER), ("t1_rows", _POINTER)),
        *(("x", _POINTER), ("x_point", _INT), ("x_row", _INT), ("x_state", _INT)),
        *(("u0", _POINTER), ("u1", _POINTER)),
        *((name, _INT) for name in ("u_point", "u_row", "u_input")),
        *(("end", _POINTER), ("end_point", _INT), ("end_row", _INT), ("end_state", _INT)),
        *(("L", _POINTER), ("m", _INT), ("draws", _POINTER)),
        *((name, _INT) for name in ("draws_step", "draws_point", "draws_row")),
        *(("F", _POINTER), ("Q", _POINTER), ("low", _POINTER), ("high", _POINTER)),
    ]


def model_kernel(system: System) -> ModelKernel | None:
    """Return the compiled steps of a plant whose library has been asked for, which are kept with
    the plant; None if it has none."""
    kept = vars(system).get(_KEPT)
    if kept is not None:
        return kept
    made = asked_library(system, "model")
    if made is None:
        return None
    vars(system)[_KEPT] = kernel = ModelKernel(system, made)
    return kernel


def _nothing() -> None:
    """What a kernel becomes in a copy of its plant or in another process, where its addresses do
    not hold."""


class ModelKernel:
    """The compiled steps of one plant. A row gives the same result alone and in any batch.

    Methods return None where NumPy has to do it, because arguments are no arrays of doubles, or
    not of a shape that is expected.

    Args:
        system: the plant.
        made: its library of the template ``model``.
    """

    def __init__(self, system: System, made: PlantLibrary) -> None:
        self._move, self._steps = made.code.move, made.code.steps
        self._move.restype, self._move.argtypes = None, [_POINTER]
        self._steps.restype, self._steps.argtypes = _INT, [_POINTER]
        self._nx, self._nu = system.nx, system.nu
        self._p = p = plant_numbers(system, made.numbers)
        self._rows = p.shape[1] if p.ndim > 1 else 0
        self._breaks = np.sort(np.asarray(system.breakpoints(), dtype=float))
        self._longest = longest_step(system)
        self._discrete, self._box = bool(system.discrete), system.state_box
        measured = {"previous": 1, "linear": 2}[system.input_hold]
        self._input = measured if system.measured_input else 0
        self._model = _Model(
            *(address(p), int(p.ndim > 1), self._longest, address(self._breaks)),
            *(len(self._breaks), self._input, int(self._discrete)),
        )
        self._at = ctypes.addressof(self._model)
        self._L: tuple[Any, np.ndarray] = None, np.empty((self._nx, 0))

    def __reduce__(self) -> Any:
        return _nothing, ()

    def step(self, t0: Any, t1: Any, x: Any, u0: Any, u1: Any) -> np.ndarray | None:
        """Return what `pinnobs_gym.simulation.model.model_step` does."""
        call, kept = self._call(t0, t1, x, u0, u1)
        if call is None:
            return None
        end = np.empty_like(x)
        _set_end(call, end)
        self._move(ctypes.addressof(call))
        del kept
        return end

    def moments(
        self, noise: Noise | None, t0: Any, t1: Any, x: Any, u0: Any, u1: Any
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Return what `pinnobs_gym.simulation.model.model_step_moments` does; without noise, Q is
        zero."""
        L = self._constant(noise)
        if L is None or getattr(x, "ndim", 1) == 1:
            return None
        call, kept = self._call(t0, t1, x, u0, u1)
        if call is None:
            return None
        nx, (batch, m), points = self._nx, (x.shape[-2], L.shape[1]), call.points
        # All results are parts of one buffer.
        ends = nx * points * batch, nx * (points + nx) * batch
        buffer: Any = np.empty(ends[1] + (nx * nx * batch if m else 0))
        start = ctypes.addressof(ctypes.c_double.from_buffer(buffer))
        end = buffer[: ends[0]].reshape(nx, points, batch).transpose(1, 2, 0)
        call.end, call.end_point, call.end_row, call.end_state = start, batch, 1, points * batch
        call.F = start + 8 * ends[0]
        if m:
            call.L, call.m, call.Q = address(L), m, start + 8 * ends[1]
        self._move(ctypes.addressof(call))
        del kept
        F = buffer[ends[0] : ends[1]].reshape(nx, nx, batch)
        Q = buffer[ends[1] :].reshape(nx, nx, batch) if m else np.zeros((nx, nx, 1))
        return (end[0] if x.ndim == 2 else end), F, Q

    def noisy(
        self,
        noise: Noise,
        t0: Any,
        t1: Any,
        x: Any,
        u0: Any,
        u1: Any,
        normal: Callable[[int], np.ndarray],
    ) -> np.ndarray | None:
        """Return what `pinnobs_gym.simulation.model.noisy_model_step` does."""
        L = self._constant(noise)
        if L is None or isinstance(t0, np.ndarray) or getattr(x, "ndim", 1) != 3:
            return None
        call, kept = self._call(t0, t1, x, u0, u1)
        if call is None:
            return None
        m = L.shape[1]
        if m:
            size = m if self._discrete else 2 * m
            drawn = [normal(size) for _ in range(self._steps(ctypes.addressof(call)))]
            if drawn:
                draws = np.ascontiguousarray(drawn[0][None] if len(drawn) == 1 else drawn)
                steps = (*draws.strides[:3],)
                steps = (8 * 0 if n == 1 else s for n, s in zip(draws.shape, steps, strict=False))
                call.draws_step, call.draws_point, call.draws_row = (s // 8 for s in steps)
                call.L, call.m, call.draws = address(L), m, address(draws)
                if self._box is not None:
                    call.low, call.high = address(self._box.low), address(self._box.high)
        end = np.empty_like(x)
        _set_end(call, end)
        self._move(ctypes.addressof(call))
        del kept
        return end

    def _constant(self, noise: Noise | None) -> np.ndarray | None:
        """Return the process noise L (nx, m), None if it may change with time."""
        if noise is None:
            return self._L[1][:, :0]
        if type(noise).L is not Noise.L and not (
            type(noise) is AssumedNoise and type(noise.told).L is Noise.L
        ):
            return None
        L, kept = noise.L(0.0), self._L
        if kept[0] is not L:
            if L.shape[2] != 1:
                return None
            kept = self._L = L, np.array(L[..., 0], dtype=float, order="C")
        return kept[1]

    def _call(self, t0: Any, t1: Any, x: Any, u0: Any, u1: Any) -> tuple[_Moved | None, Any]:
        """Return the structure of a call without results, and arrays that have to live until it is
        used; None if NumPy has to do it."""
        if type(x) is not np.ndarray or x.dtype is not _FLOAT or not x.size:
            return None, None
        if not x.flags.aligned:
            return None, None
        *outer, nx = x.shape
        if nx != self._nx or len(outer) > 2:
            return None, None
        points, batch = (*(1,) * (2 - len(outer)), *outer)
        if self._rows and batch != self._rows:
            return None, None
        times: Any = (t0, t1, None, None)
        kept: Any = None
        if isinstance(t0, np.ndarray) or isinstance(t1, np.ndarray):
            kept = self._own_times(t0, t1, batch)
            if kept is None:
                return None, None
            times = 0.0, 0.0, address(kept[0]), address(kept[1])
        elif not self._usual_times(t0, t1):
            return None, None
        states = address(x), *_strides(x.strides, x.shape)
        inputs: Any = None, None, 0, 0, 0
        if self._input:
            joined = self._input == 2
            if not self._fits(u0, points, batch) or (joined and not self._fits(u1, points, batch)):
                return None, None
            if joined and u1.shape != u0.shape:
                return None, None
            if joined and u1.strides != u0.strides:
                u0, u1 = kept_u = np.ascontiguousarray(u0), np.ascontiguousarray(u1)
                kept = kept, kept_u
            strides = _strides(u0.strides, u0.shape)
            inputs = address(u0), address(u1) if joined else None, *strides
        return _Moved(self._at, points, batch, *times, *states, *inputs), kept

    def _own_times(self, t0: Any, t1: Any, batch: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the times of each row, (batch,)."""
        if np.ndim(t0) > 1 or np.ndim(t1) > 1:
            return None
        try:
            start = np.ascontiguousarray(np.broadcast_to(t0, (batch,)), dtype=float)
            end = np.ascontiguousarray(np.broadcast_to(t1, (batch,)), dtype=float)
        except ValueError:
            return None
        whole = end - start
        if not (whole.min() >= 0 and whole.max() / self._longest <= _LARGEST_COUNT):
            return None
        if self._discrete and not ((start % 1 == 0).all() and (end % 1 == 0).all()):
            return None
        return start, end

    def _usual_times(self, t0: float, t1: float) -> bool:
        """Return whether a time follows another one, both whole numbers for a map."""
        if not (t0 <= t1 and (t1 - t0) / self._longest <= _LARGEST_COUNT):
            return False
        return not self._discrete or (t0 % 1 == 0 and t1 % 1 == 0)

    def _fits(self, u: Any, points: int, batch: int) -> bool:
        """Return whether inputs broadcast to (points, batch, nu)."""
        if type(u) is not np.ndarray or u.dtype is not _FLOAT or u.shape[-1:] != (self._nu,):
            return False
        if not u.flags.aligned:
            return False
        outer = u.shape[:-1]
        wanted = (points, batch)[2 - len(outer) :] if len(outer) < 3 else ()
        fits = all(n in (1, w) for n, w in zip(outer, wanted, strict=False))
        return len(outer) < 3 and fits and bool(self._nu)


def _set_end(call: _Moved, end: np.ndarray) -> None:
    call.end = address(end)
    call.end_point, call.end_row, call.end_state = _strides(end.strides, end.shape)


def _strides(strides: tuple[int, ...], shape: tuple[int, ...]) -> tuple[int, int, int]:
    """Return the distances in doubles between points, rows and components of an array of at most
    three axes; zero along axes of length one, and those that it does not have."""
    if len(strides) == 2:
        return 0, strides[0] // 8 if shape[0] > 1 else 0, strides[1] // 8
    if len(strides) == 3:
        point, row = (s // 8 if n > 1 else 0 for s, n in zip(strides, shape[:2], strict=False))
        return point, row, strides[2] // 8
    return 0, 0, strides[0] // 8
