"""Values of a model's function at sigma points, also where some of these cannot be used."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from pinnobs_gym.estimation.projection import nearest_points
from pinnobs_gym.simulation.bounds import Box
from pinnobs_gym.simulation.matrices import product
from pinnobs_gym.simulation.notices import say_once

_HALVINGS = 20
"""Largest number of times that the distance of a row's points from the estimate is halved."""


def images(
    function: Callable[[np.ndarray], np.ndarray],
    jacobian: Callable[[], np.ndarray],
    centre: np.ndarray,
    deviations: np.ndarray,
    bounds: tuple[Box, np.ndarray] | None,
    notice: str,
) -> np.ndarray:
    """Return the values of a function at sigma points, shape (num_points, batch, m).

    A point outside of the bounds is replaced by the nearest one inside, as an estimate is. The
    points of a row at one of which the function is not finite are moved towards the estimate, their
    distances halved until it is finite at all of them, and the log says so once. In both cases the
    value is extended from the point that is used to the original one by the function's Jacobian at
    the estimate. Means and covariances thus remain those of the original points, exactly if the
    function is linear.

    Args:
        function: takes states (num_points, batch, nx), and returns values (num_points, batch, m).
        jacobian: returns the Jacobians of the function at the estimates, shape (m, nx, batch).
        centre: estimates, shape (batch, nx).
        deviations: deviations of the points from them, shape (nx, num_points, batch).
        bounds: the box of the states, if there is one, and the covariances (batch, nx, nx) that
            measure which of its points is the nearest.
        notice: the line for the log.
    """
    points = (deviations + centre.T[:, None]).transpose(1, 2, 0)
    used = points if bounds is None else nearest_points(points, bounds[1], bounds[0])
    values = np.asarray(function(used))
    if not math.isfinite(values.sum()):
        # Rows whose function is defined at the estimate, but not at all points.
        defined = np.isfinite(np.asarray(function(centre[None]))).all(axis=(0, 2))
        bad = np.logical_and(defined, ~np.isfinite(values).all(axis=(0, 2)))
        if bad.any():
            used, values = _closer(function, centre, used, values, bad)
            say_once(notice)
    if used is points:
        return values
    moved = np.flatnonzero((used != points).any(axis=(0, 2)))
    if len(moved):
        # Extend the values to first order, in the rows that have other points than the original.
        rest = np.ascontiguousarray((points[:, moved] - used[:, moved]).transpose(2, 0, 1))
        values = values.copy(order="K")
        values[:, moved] += product(jacobian()[..., moved], rest).transpose(1, 2, 0)
    return values


def _closer(
    function: Callable[[np.ndarray], np.ndarray],
    centre: np.ndarray,
    used: np.ndarray,
    values: np.ndarray,
    bad: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return points and values in which those of the bad rows, bool (batch,), are halfway to the
    estimate, or a quarter of the way, and so on, where the function is finite.

    Args:
        function: see `images`.
        centre: the estimates, shape (batch, nx).
        used: the points so far, shape (num_points, batch, nx).
        values: the values at them, shape (num_points, batch, m).
        bad: rows in which some values are not finite.
    """
    share = 1.0
    for _ in range(_HALVINGS):
        share /= 2
        nearer = centre + share * (used - centre)
        tried = np.asarray(function(nearer))
        better = bad & np.isfinite(tried).all(axis=(0, 2))
        keep = better[:, None]
        used, values = np.where(keep, nearer, used), np.where(keep, tried, values)
        bad = bad & ~better
        if not bad.any():
            break
    return used, values
