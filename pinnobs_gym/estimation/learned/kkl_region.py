"""The region in which a KKL observer was trained, and whether z is still in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

POINTS = 256
"""Number of points that stand for the region."""
_CANDIDATES = 20_000
"""Largest number of samples among which these are chosen."""
_AT_ONCE = 2000
"""Number of pairs whose distances are in memory at a time."""


@dataclass(frozen=True, eq=False)
class Region:
    """The pairs of z and x̂ = T*(z) of the training's episodes, and what is near one of them.

    z alone would not do. T* may leave the states of the training where z is still close to those of
    the training, in directions in which z says little, and a network that is saturated may give
    such states for a z that is far away.
    """

    mean: np.ndarray
    """Means of z and x̂ in the training, shape (nz + nx,)."""
    scale: np.ndarray
    """Their standard deviations, or 1 where these are 0, shape (nz + nx,)."""
    points: np.ndarray
    """Standardised pairs, spread over all of them, shape (count, nz + nx)."""
    radius: float
    """Largest distance of a pair of the training from the nearest of the points."""

    @classmethod
    def of(cls, z: np.ndarray, xhat: np.ndarray, seed: int) -> Region:
        """Return the region of z (count, nz) with the estimates x̂ (count, nx).

        Each point is the pair farthest from those before it (Gonzalez, "Clustering to minimize the
        maximum intercluster distance", 1985), among pairs drawn with the seed.
        """
        pairs = np.concatenate([z, xhat], axis=1)
        mean, std = pairs.mean(axis=0), pairs.std(axis=0)
        scale = np.where(std > 0, std, 1.0)
        pairs = (pairs - mean) / scale
        rng = np.random.default_rng([seed, 2])
        chosen = rng.permutation(len(pairs))[:_CANDIDATES]
        points = _spread(pairs[chosen], min(POINTS, len(chosen)))
        blocks = np.array_split(pairs, -(-len(pairs) // _AT_ONCE))
        radius = max(float(_distances(block, points).max()) for block in blocks)
        return cls(mean, scale, points, radius)

    def outside(self, z: np.ndarray, xhat: np.ndarray) -> np.ndarray:
        """Return which of z (batch, nz) with their x̂ (batch, nx) are outside, bool (batch,). Those
        that are not finite are."""
        pairs = (np.concatenate([z, xhat], axis=1) - self.mean) / self.scale
        return ~(_distances(pairs, self.points) <= self.radius)


def _spread(pairs: np.ndarray, count: int) -> np.ndarray:
    """Return the chosen pairs (count, size): the first one, then each the farthest from those
    before it."""
    chosen = [0]
    nearest = np.full(len(pairs), np.inf)
    for _ in range(count - 1):
        nearest = np.minimum(nearest, np.square(pairs - pairs[chosen[-1]]).sum(axis=1))
        chosen.append(int(nearest.argmax()))
    return pairs[chosen]


def _distances(pairs: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the distance of each of the pairs (batch, size) from the nearest point, (batch,)."""
    squares = -2 * pairs @ points.T + np.square(points).sum(axis=1)
    return np.sqrt(np.maximum(squares.min(axis=1) + np.square(pairs).sum(axis=1), 0.0))
