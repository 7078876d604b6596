"""Means of points on circles: ensembles and particles whose states or outputs are angles."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation.matrices import total
from pinnobs_gym.simulation.residual import Periods, nearest


def gathered(
    points: np.ndarray, periods: Periods | None, weights: np.ndarray | None = None
) -> np.ndarray:
    """Return points (num_points, batch, n), in which components that repeat are moved by whole
    periods to within half a period of their circular mean (Mardia & Jupp 2000, "Directional
    Statistics", section 2.2).

    Means and deviations of the result are then those of numbers. Points within half a period of
    the mean are unchanged, and so are all points without periods.

    Args:
        points: the points; where a value is not finite, it does not count in the mean.
        periods: see `pinnobs_gym.simulation.residual`.
        weights: weights of the points, shape (num_points, batch); equal if None.
    """
    if periods is None:
        return points
    centre = np.zeros(points.shape[1:])
    with np.errstate(invalid="ignore"):  # values that are not finite
        for i, period in enumerate(periods):
            if period is None:
                continue
            # Angles about the first point, so that the mean is near it and moves continuously.
            first = np.where(np.isfinite(points[0, :, i]), points[0, :, i], 0.0)
            angle = (2 * np.pi / period) * (points[..., i] - first)
            weight = np.isfinite(angle) * (1.0 if weights is None else weights)
            angle = np.where(weight > 0, angle, 0.0)
            sine, cosine = (total(weight * part(angle)) for part in (np.sin, np.cos))
            centre[:, i] = first + period / (2 * np.pi) * np.arctan2(sine, cosine)
    return nearest(points, centre, periods)
