"""Values of a model's function at sigma points, also where some of these cannot be used."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.estimation.projection import nearest_points
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.matrices import product
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.residual import Periods, nearest

_HALVINGS = 20
"""Largest number of times that the distance of a row's points from the estimate is halved."""
_STEPS = 64
"""Number of steps in which the way from the estimate to a point is followed around a circle."""


@dataclass(frozen=True, eq=False)
class SigmaPoints:
    """Sigma points of a batch of estimates, and those at which functions are evaluated instead."""

    centre: np.ndarray
    """Estimates, shape (batch, nx)."""
    original: np.ndarray
    """The points, shape (num_points, batch, nx)."""
    used: np.ndarray
    """The points, with those outside of the bounds replaced by the nearest ones inside, as an
    estimate is; the same array if there are no bounds."""

    @staticmethod
    def of(
        centre: np.ndarray, deviations: np.ndarray, box: StateBox | None, P: np.ndarray | None
    ) -> SigmaPoints:
        """Return the points with the given deviations (nx, num_points, batch) from the estimates
        (batch, nx), within the box, if there is one; P (batch, nx, nx) measures distances."""
        points = (deviations + centre.T[:, None]).transpose(1, 2, 0)
        if box is None or P is None:
            return SigmaPoints(centre, points, points)
        return SigmaPoints(centre, points, nearest_points(points, P, box))

    def images(
        self,
        values: np.ndarray,
        function: Callable[[np.ndarray], np.ndarray],
        jacobian: Callable[[], np.ndarray],
        notice: Callable[[], str],
    ) -> np.ndarray:
        """Return the values of a function at the original points, shape (num_points, batch, m).

        The points of a row at one of which the function is not finite are moved towards the
        estimate, their distances halved until it is finite at all of them, and the log says so
        once. From points that are not the original ones, values are extended by the function's
        Jacobian at the estimate. Means and covariances thus remain those of the original points,
        exactly if the function is linear.

        Args:
            values: the values at the points ``used``, shape (num_points, batch, m).
            function: takes states (any number, batch, nx), and returns values (any number, batch,
                m).
            jacobian: returns the Jacobians of the function at the estimates, shape (m, nx, batch).
            notice: returns the line for the log, empty for none.
        """
        used, points = self.used, self.original
        if not math.isfinite(values.sum()):
            # Rows whose function is defined at the estimate, but not at all points.
            defined = np.isfinite(np.asarray(function(self.centre[None]))).all(axis=(0, 2))
            bad = np.logical_and(defined, ~np.isfinite(values).all(axis=(0, 2)))
            if bad.any():
                used, values = _closer(function, self.centre, used, values, bad)
                if line := notice():
                    say_once(line)
        if used is points:
            return values
        moved = np.flatnonzero((used != points).any(axis=(0, 2)))
        if len(moved):
            # Extend the values to first order, in the rows that have other points.
            rest = np.ascontiguousarray((points[:, moved] - used[:, moved]).transpose(2, 0, 1))
            values = values.copy(order="K")
            values[:, moved] += product(jacobian()[..., moved], rest).transpose(1, 2, 0)
        return values

    def unwound(
        self,
        values: np.ndarray,
        function: Callable[[np.ndarray], np.ndarray],
        jacobian: Callable[[], np.ndarray],
        periods: Periods | None,
    ) -> np.ndarray:
        """Return values of a function at the points, in which angles have the turns that they gain
        on the straight way from the estimate to each point.

        Where the Jacobian tells that they are within a quarter of a turn of their value at the
        estimate, they are taken within half a turn of it; else the way is followed in steps.

        Args:
            values: the values, shape (num_points, batch, m).
            function: as in `images`.
            jacobian: as in `images`.
            periods: those of the values; without any, these are unchanged.
        """
        if periods is None:
            return values
        start = np.asarray(function(self.centre[None]))
        values = nearest(values, start, periods)
        way = self.original - self.centre
        moved = abs(product(jacobian(), np.ascontiguousarray(way.transpose(2, 0, 1))))
        bound = np.array([np.inf if each is None else each / 4 for each in periods])
        far = ~(bound >= moved.max(axis=1).T)  # also where it is not finite
        rows = far.any(axis=1)
        if not rows.any():
            return values
        reference = start
        for step in range(1, _STEPS):
            middle = np.asarray(function(self.centre + step / _STEPS * way))
            middle = nearest(middle, reference, periods)
            reference = np.where(np.isfinite(middle), middle, reference)
        return np.where(rows[:, None], nearest(values, reference, periods), values)


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
        function: see `SigmaPoints.images`.
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
