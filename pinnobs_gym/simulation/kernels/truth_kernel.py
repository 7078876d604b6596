"""The truth's steps of fixed length in compiled code."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from pinnobs_gym.simulation import dop853
from pinnobs_gym.simulation.driven import Driven
from pinnobs_gym.simulation.kernels.calls import address, plant_numbers
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary
from pinnobs_gym.simulation.mesh import NODES, Mesh
from pinnobs_gym.simulation.system import System, vector

_POINTER, _INT = ctypes.c_void_p, ctypes.c_int64
_STAGES = len(dop853.B)


class Solution(ctypes.Structure):
    """``struct solution`` of ``truth.c``."""

    _fields_ = [
        *(("batch", _INT), ("steps", _INT), ("p", _POINTER), ("p_rows", _INT)),
        *((name, _POINTER) for name in ("x0", "step")),
        *((name, _POINTER) for name in ("t", "u", "u_ends", "u_part", "u_interval", "out")),
        *(("out_sample", _INT), ("out_row", _INT), ("out_state", _INT)),
        *((name, _POINTER) for name in ("bounds", "window", "weights")),
        *(("checks", _INT), ("checked", _POINTER), ("check", _POINTER)),
        *(("scale", _POINTER), ("error", _POINTER), ("end", _POINTER)),
        *(("m", _INT), ("L", _POINTER), ("draws", _POINTER)),
        *(("part", _POINTER), ("part_start", _POINTER), ("part_length", _POINTER)),
        *(("low", _POINTER), ("high", _POINTER)),
    ]


class TruthKernel:
    """The compiled solver of a plant; the result of a row is the same in any batch.

    Args:
        made: the plant's library of the template ``truth``.
    """

    def __init__(self, made: PlantLibrary) -> None:
        self._numbers = made.numbers
        self._solve = made.code.solve
        self._solve.restype, self._solve.argtypes = None, [ctypes.c_void_p]

    def fixed_step(
        self, system: System, x0: np.ndarray, mesh: Mesh, out: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Write the states at the samples of a mesh to ``out`` (num_samples, batch, nx). Return the
        states at the end, and the local error of each row (batch,).

        Args:
            system: the plant, or one with inputs that are given at both ends.
            x0: initial states, shape (batch, nx).
            mesh: the mesh.
            out: array for the result.
        """
        flat, error = _flat(mesh), np.empty(len(x0))
        inputs: dict[str, Any] = {"t": flat.t}
        if isinstance(system, Driven):
            part = (flat.t - system.start) / (system.end - system.start)
            u = np.stack([system.first, system.second])
            u = np.broadcast_to(u, (2, len(x0), system.nu))
            inputs |= _given(system, u, part, np.zeros(len(mesh.steps)))
            system = system.plant
        fields = {
            **{"bounds": mesh.bounds, "window": flat.window, "weights": flat.weights},
            **{"checked": mesh.checked, "check": flat.check, "error": error},
            **{"step": mesh.steps, "scale": vector(system.scale, system.nx, "scale")},
        }
        return self._solved(system, x0, out, **fields, **inputs), error

    def disturbed(
        self,
        system: System,
        L: np.ndarray,
        times: np.ndarray,
        draws: np.ndarray,
        longest: float,
        x: np.ndarray,
        inputs: np.ndarray | None,
    ) -> None:
        """Write the states with process noise L (nx, m) at samples 1 and later to ``x``
        (num_samples, batch, nx), whose first is given. The other arguments are those of
        `pinnobs_gym.simulation.truth.disturbed_truth`."""
        parts = len(times) - 1, draws.shape[1]
        draws = np.broadcast_to(draws, (*parts, 2, len(x[0]), L.shape[1]))
        steps = _disturbed_steps(times, draws.shape[1], tuple(system.breakpoints()), longest)
        given: dict[str, Any] = {"t": steps.t}
        if inputs is not None:
            inputs = np.broadcast_to(inputs, (len(times), len(x[0]), system.nu))
            start, end = (np.repeat(times[steps.interval + k], _STAGES) for k in (0, 1))
            given |= _given(system, inputs, (steps.t - start) / (end - start), steps.interval)
        force = {"part": steps.part, "part_start": steps.start, "part_length": steps.length}
        fields = {"bounds": steps.bounds, "step": steps.step, "L": L, "draws": draws}
        if (box := system.state_box) is not None:
            fields |= {"low": box.low, "high": box.high}
        self._solved(system, x[0], x[1:], **fields, **force, **given)

    def _solved(
        self, system: System, x0: np.ndarray, out: np.ndarray, **arrays: np.ndarray
    ) -> np.ndarray:
        """Call the solver with these arrays of ``struct solution``; return the states at the end,
        (batch, nx)."""
        p, end = plant_numbers(system, self._numbers), np.empty((len(x0), system.nx))
        if p.ndim > 1:  # or a ValueError in one line, as of NumPy
            p = np.broadcast_to(p, (len(p), len(x0)))
        if p.ndim == 1 and "u_ends" not in arrays and system.nu:
            u = np.asarray(system.input(arrays["t"]), dtype=float)
            arrays["u"] = np.broadcast_to(u, (len(arrays["t"]), system.nu))
        s = Solution(batch=len(x0), steps=len(arrays["step"]), p_rows=int(p.ndim > 1))
        s.checks = len(arrays.get("checked", ()))
        s.m = arrays["L"].shape[1] if "L" in arrays else 0
        s.out_sample, s.out_row, s.out_state = (size // 8 for size in out.strides)
        s.out = address(out)
        kept = {}
        for name, array in (arrays | {"p": p, "x0": x0, "end": end}).items():
            whole = name in ("bounds", "window", "checked", "u_interval", "part")
            kept[name] = np.ascontiguousarray(array, dtype=np.int64 if whole else float)
            setattr(s, name, address(kept[name]))
        self._solve(ctypes.addressof(s))
        return end


def _given(
    system: System, u: np.ndarray, part: np.ndarray, interval: np.ndarray
) -> dict[str, np.ndarray]:
    """Return what says how inputs u (num_samples, batch, nu) are joined at points in time, given
    their positions in the interval and the number of each step's interval."""
    if system.input_hold == "previous":
        part = np.zeros_like(part)
    return {"u_ends": u, "u_part": part, "u_interval": interval}


class _Flat(NamedTuple):
    """A mesh in the layout of compiled code."""

    t: np.ndarray
    """Times in s at which f is evaluated."""
    window: np.ndarray
    """The first node of each interval's polynomial."""
    weights: np.ndarray
    """The weights of all samples, (num_samples, 2·NODES)."""
    check: np.ndarray
    """Those of all checks, (num_checks, 2, 2·NODES)."""


@lru_cache(maxsize=64)
def _flat(mesh: Mesh) -> _Flat:
    last = np.nextafter(mesh.nodes[-1], mesh.nodes[0])  # f may jump at the end: its left limit
    k = mesh.checked
    stages = mesh.nodes[:-1, None] + np.multiply.outer(mesh.steps, dop853.C)
    middle = mesh.nodes[k] + mesh.steps[k] / 2
    t = np.minimum(np.concatenate([stages.ravel(), middle, mesh.nodes[-1:]]), last)
    window = np.array([rows.start // 2 for rows, _ in mesh.intervals])
    weights = np.concatenate([np.empty((0, 2 * NODES)), *(w for _, w in mesh.intervals)])
    return _Flat(t, window, weights, np.array([w for _, w in mesh.checks]))


class _Steps(NamedTuple):
    """The steps of a plant with process noise."""

    t: np.ndarray
    """Times of their stages in s."""
    step: np.ndarray
    """Their lengths in s."""
    interval: np.ndarray
    """The interval between samples of each."""
    part: np.ndarray
    """The part of each, over which the noise is linear."""
    start: np.ndarray
    """Start of each part in s."""
    length: np.ndarray
    """Its length in s."""
    bounds: np.ndarray
    """The number of samples before each step, and at the end."""


def _disturbed_steps(
    times: np.ndarray, parts: int, breaks: tuple[float, ...], longest: float
) -> _Steps:
    """Return the steps between samples: equal parts of each interval have noise of their own, steps
    are no longer than ``longest``, and begin anew at each breakpoint."""
    edges = np.linspace(times[:-1], times[1:], parts + 1, axis=1)
    starts, ends = edges[:, :-1].ravel(), edges[:, 1:].ravel()
    inner = [b for b in breaks if times[0] < b < times[-1]]
    begin = np.unique(np.concatenate([starts, inner]))
    part = np.searchsorted(starts, begin, side="right") - 1
    stop = np.minimum(np.append(begin[1:], times[-1]), ends[part])
    count = np.maximum(1, np.ceil((stop - begin) / longest - 1e-9)).astype(int)
    size = np.round((stop - begin) / count, 15)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    begin, step, stop, part = (np.repeat(a, count) for a in (begin, size, stop, part))
    t = (begin + number * step)[:, None] + np.multiply.outer(step, dop853.C)
    t = np.minimum(t, np.nextafter(stop, begin)[:, None])
    interval = part // parts
    done = np.searchsorted(interval, np.arange(len(times)), side="left")
    bounds = np.zeros(len(step) + 1, dtype=int)
    np.add.at(bounds, done[1:], 1)
    return _Steps(t.ravel(), step, interval, part, starts, ends - starts, np.cumsum(bounds))
