"""The mesh on which the truth is solved, and the polynomials between its nodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev

NODES = 6
"""Number of nodes of an interpolating polynomial, which has the state and its slope at each."""

_Weights = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Mesh:
    """The solver's nodes over an interval, and the interpolating polynomials between them."""

    nodes: np.ndarray
    """Times of the nodes in s."""
    steps: np.ndarray
    """Times between them in s."""
    bounds: np.ndarray
    """Index of the first sample of each interval between nodes."""
    intervals: list[tuple[slice, np.ndarray]]
    """For each interval, the rows of (state, slope, state, slope, ...) at the nodes of its
    polynomial, and their weights in the states at the interval's samples."""
    checked: np.ndarray
    """The intervals whose defect is checked: every third, and the last."""
    checks: list[tuple[slice, np.ndarray]]
    """For each checked interval, the same rows, and their weights in the state and slope midway."""


@lru_cache(maxsize=64)
def mesh_of(start: float, end: float, steps: int, times: bytes) -> Mesh:
    """Return the mesh of an interval.

    Args:
        start: its start in s.
        end: its end in s.
        steps: number of steps, at least `NODES`.
        times: the sample times in s, as bytes.
    """
    samples = np.frombuffer(times)
    step = (end - start) / steps
    # Half steps at both ends, where the polynomials are one-sided and thus less accurate.
    short = np.arange(6) / 2
    nodes = start + step * np.concatenate([short, np.arange(3, steps - 2), steps - short[::-1]])
    nodes[-1] = end
    # Assign each sample to the interval between nodes that contains it.
    interval = np.clip(np.searchsorted(nodes, samples, side="right") - 1, 0, len(nodes) - 2)
    bounds = np.searchsorted(interval, np.arange(len(nodes)))
    checked = np.unique(np.append(np.arange(0, len(nodes) - 1, 3), len(nodes) - 2))
    # The nearest nodes, shifted inwards at the ends; time is in steps from the first of them.
    k = np.arange(len(nodes) - 1)
    first = np.clip(k - NODES // 2 + 1, 0, len(nodes) - NODES)
    windows = (nodes[first[:, None] + np.arange(NODES)] - nodes[first][:, None]) / step
    inside = (samples - nodes[first[interval]]) / step
    middle = (windows[k, k - first] + windows[k, k - first + 1]) / 2
    units = np.tile([1.0, step], NODES)  # slopes per s to slopes per step
    weights, midway = np.empty((len(samples), 2 * NODES)), np.empty((len(k), 2, 2 * NODES))
    # Polynomials whose nodes are spaced alike have the same weights.
    shapes, shape = np.unique(np.round(windows, 6), axis=0, return_inverse=True)
    for i, window in enumerate(shapes.tolist()):
        value, slope = _hermite(tuple(window))
        own, alike = shape[interval] == i, shape == i
        weights[own] = value(inside[own]) * units
        midway[alike, 0] = value(middle[alike]) * units
        midway[alike, 1] = slope(middle[alike]) / step * units
    rows = [slice(2 * f, 2 * (f + NODES)) for f in first.tolist()]
    intervals = [(rows[i], weights[bounds[i] : bounds[i + 1]]) for i in k.tolist()]
    checks = [(rows[i], midway[i]) for i in checked.tolist()]
    return Mesh(nodes, np.round(np.diff(nodes), 15), bounds, intervals, checked, checks)


@lru_cache(maxsize=64)
def _hermite(nodes: tuple[float, ...]) -> tuple[_Weights, _Weights]:
    """Return two functions of times (num_times,) that give weights (num_times, 2·num_nodes): those
    of (value, slope, value, slope, ...) at the nodes in the value, and in the slope, of the Hermite
    interpolating polynomial."""
    size = 2 * len(nodes)
    # Chebyshev basis on the span of the nodes, for a well-conditioned system.
    centre, half = (nodes[0] + nodes[-1]) / 2, (nodes[-1] - nodes[0]) / 2
    derivative = chebyshev.chebder(np.eye(size)) / half

    def values(t: np.ndarray) -> np.ndarray:
        return chebyshev.chebvander((t - centre) / half, size - 1)

    def slopes(t: np.ndarray) -> np.ndarray:
        return chebyshev.chebvander((t - centre) / half, size - 2) @ derivative

    # Solve the interpolation conditions for the coefficients.
    at = np.asarray(nodes)
    conditions = np.stack([values(at), slopes(at)], axis=1).reshape(size, size)
    inverse = np.linalg.inv(conditions)
    return lambda t: values(t) @ inverse, lambda t: slopes(t) @ inverse
