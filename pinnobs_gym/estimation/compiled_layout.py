"""Where the arrays of a state are in a buffer of compiled code."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

_DOUBLE = np.dtype(float)
_NAMES = "xhat", "P", "innovation", "S"


@dataclass(frozen=True, eq=False)
class Layout:
    """A buffer that has all arrays of a state one after the other: the time, outputs, inputs,
    estimates, covariances, innovations and their covariances of a batch, the numbers by which
    compiled code marks rows, and what some algorithms have beside; see ``update`` in
    ``templates/filter.c``, and ``templates/members.c``."""

    buffer: Any
    """The type of the buffer."""
    inputs_place: int
    """Position of the inputs (nu, batch) in bytes."""
    nu: int
    """Number of inputs."""
    views: tuple[tuple[str, tuple[int, ...], int, tuple[int, ...]], ...]
    """Names in `pinnobs_gym.estimation.estimator.State`, shapes, positions in bytes and strides of
    the estimates (batch, nx) and so on."""
    places: dict[str, slice]
    """Places of the same in doubles."""
    marks: int
    """Position of the numbers that mark rows in bytes."""

    @staticmethod
    def of(
        nx: int, ny: int, nu: int, batch: int, names: Sequence[str] = _NAMES, more: int = 0
    ) -> Layout:
        """Return the layout for a model of these sizes and a batch, of an estimator that computes
        the fields of `State` with these names, with further numbers for each row."""
        covariances = [(nx, nx), (ny, ny)] if "P" in names else [(0,), (0,)]
        shapes = [(nx,), covariances[0], (ny,), covariances[1]]
        sizes = [1, ny * batch, nu * batch, *(batch * int(np.prod(shape)) for shape in shapes)]
        ends = [8 * int(end) for end in np.cumsum(sizes)]
        views = []
        for name, shape, place in zip(_NAMES, shapes, ends[2:], strict=False):
            array = np.moveaxis(np.empty((*shape, batch)), -1, 0)
            if name in names:
                views.append((name, array.shape, place, array.strides))
        kind = ctypes.c_double * (ends[-1] // 8 + (1 + more) * batch)
        buffer = type("Packed", (kind,), {"__reduce__": _left_behind})
        parts = zip(_NAMES, pairwise(end // 8 for end in ends[2:]), strict=True)
        places = {name: slice(*part) for name, part in parts if name in names}
        return Layout(buffer, ends[1], nu, tuple(views), places, ends[-1])

    def arrays(self, buffer: Any) -> dict[str, np.ndarray]:
        """Return the estimates (batch, nx), their covariances, the innovations and their
        covariances in a buffer, by name, as far as there are any."""
        return {
            name: np.ndarray(shape, _DOUBLE, buffer, place, strides)
            for name, shape, place, strides in self.views
        }

    def inputs(self, buffer: Any) -> np.ndarray:
        """Return the inputs (batch, nu) in a buffer."""
        batch = self.views[0][1][0]
        return np.ndarray((self.nu, batch), _DOUBLE, buffer, self.inputs_place).T

    def packed(self, t: float | None, u: Any, xhat: np.ndarray, P: np.ndarray | None) -> Any:
        """Return a new buffer with the values of a state, see
        `pinnobs_gym.estimation.estimator.State`."""
        buffer = self.buffer()
        if t is not None:
            buffer[0] = t
        if u is not None and self.nu:
            self.inputs(buffer)[:] = u
        arrays = self.arrays(buffer)
        arrays["xhat"][:] = xhat
        if "P" in arrays:
            arrays["P"][:] = P
        return buffer


@dataclass(frozen=True, eq=False)
class SetLayout:
    """A buffer of a state, in which the sets of points of all rows follow the other arrays."""

    layout: Layout
    views: tuple[tuple[tuple[int, ...], int, tuple[int, ...]], ...]
    """Shape, position in bytes and strides of the arrays of the estimator's memory."""

    @staticmethod
    def of(sizes: tuple[int, int, int], shapes: Sequence[tuple[int, ...]], batch: int) -> SetLayout:
        """Return the layout for a model of sizes (nx, ny, nu), and what each row has beside: arrays
        of these shapes, of which the last is not kept with a state."""
        numbers = [math.prod(shape) for shape in shapes]
        layout = Layout.of(*sizes, batch, more=sum(numbers))
        views, place = [], layout.marks + 8 * batch
        for shape, number in zip(shapes[:-1], numbers[:-1], strict=True):
            array = np.empty((batch, *shape))
            array = array.transpose(2, 0, 1) if array.ndim == 3 else array.T
            views.append((array.shape, place, array.strides))
            place += 8 * batch * number
        return SetLayout(layout, tuple(views))

    def arrays(self, buffer: Any) -> list[np.ndarray]:
        """Return the arrays of the memory in a buffer."""
        return [
            np.ndarray(shape, _DOUBLE, buffer, place, strides)
            for shape, place, strides in self.views
        ]


def _left_behind(self: Any) -> tuple[Any, ...]:
    """Return what is copied or pickled in place of a buffer: None, because its address holds in its
    own place and process only."""
    return type(None), ()


def contiguous(array: np.ndarray) -> bytes:
    """Return the numbers of an array (batch, n) with the batch last."""
    if getattr(array, "dtype", None) is not _DOUBLE:
        array = np.asarray(array, dtype=float)
    return array.T.tobytes()
