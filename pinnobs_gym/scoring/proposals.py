"""Mixtures from which importance sampling draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

COMPONENTS = 12
"""Largest number of components of a fitted mixture."""
_DEGREES = 5.0
"""Degrees of freedom of the components: their tails are heavier than a Gaussian's, so that weights
stay bounded where a component is a little too narrow."""
_WIDER = 1.2
"""Factor of the components' scale matrices over the covariances that they are fitted to."""
_RESAMPLED = 2048
"""Number of points that a mixture is fitted to."""
_FEWEST = 8
"""Smallest number of points per dimension of a component of its own."""
_DEFENSIVE = 0.1
"""Probability of the component that is fitted to all points."""


@dataclass(frozen=True)
class Mixture:
    """A mixture of Student distributions with five degrees of freedom."""

    probabilities: np.ndarray
    """Shape (components,)."""
    means: np.ndarray
    """Shape (components, n)."""
    roots: np.ndarray
    """Lower triangular roots of the scale matrices, shape (components, n, n)."""

    @classmethod
    def fitted(cls, x: np.ndarray, weights: np.ndarray, rng: np.random.Generator) -> Self:
        """Fit a mixture to weighted points.

        The points are resampled and divided into clusters (k-means in whitened coordinates), each
        of which becomes a component; one more is fitted to all points. A curved or divided set is
        thus followed by small components.

        Args:
            x: points, shape (num_points, n), which span all dimensions.
            weights: of the points, shape (num_points,); they sum to one.
            rng: the random number generator.
        """
        from scipy.cluster.vq import kmeans2  # takes long to import

        n = x.shape[1]
        mean = weights @ x
        deviations = x - mean
        cov = (weights[:, None] * deviations).T @ deviations
        cov += 1e-12 * np.diag(np.diag(cov)) + 1e-300 * np.eye(n)
        root = np.linalg.cholesky(cov)
        # Systematic resampling: one uniform number places all points.
        places = (np.arange(_RESAMPLED) + rng.uniform()) / _RESAMPLED
        chosen = np.minimum(np.searchsorted(np.cumsum(weights), places), len(weights) - 1)
        white = np.linalg.solve(root, deviations[chosen].T).T
        distinct = len(np.unique(chosen))
        count = min(COMPONENTS, distinct // (_FEWEST * n))
        probabilities, means, roots = [_DEFENSIVE], [mean], [np.sqrt(_WIDER) * root]
        if count > 1:
            centres, labels = kmeans2(white, count, minit="++", rng=rng)
            for c in range(len(centres)):
                own = white[labels == c]
                if len(np.unique(own[:, 0])) < _FEWEST * n:
                    continue  # too few different points to tell a covariance
                off = own - own.mean(axis=0)
                within = off.T @ off / len(own) + 1e-6 * np.eye(n)
                probabilities.append((1 - _DEFENSIVE) * len(own) / _RESAMPLED)
                means.append(mean + root @ own.mean(axis=0))
                roots.append(root @ np.linalg.cholesky(_WIDER * within))
        total = np.array(probabilities)
        return cls(total / total.sum(), np.array(means), np.array(roots))

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Draw points (count, n)."""
        n = self.means.shape[1]
        which = rng.choice(len(self.probabilities), size=count, p=self.probabilities)
        normal = rng.standard_normal((count, n))
        student = normal / np.sqrt(rng.chisquare(_DEGREES, (count, 1)) / _DEGREES)
        return self.means[which] + np.einsum("mij,mj->mi", self.roots[which], student)

    def log_density(self, x: np.ndarray) -> np.ndarray:
        """Return the logarithm of the density at points (count, n), up to a constant that is that
        of all mixtures of n dimensions, (count,)."""
        n = x.shape[1]
        parts = []
        for probability, mean, root in zip(self.probabilities, self.means, self.roots, strict=True):
            white = np.linalg.solve(root, (x - mean).T)
            square = (white**2).sum(axis=0)
            log_size = np.log(np.diag(root)).sum()
            kernel = -(n + _DEGREES) / 2 * np.log1p(square / _DEGREES)
            parts.append(np.log(probability) - log_size + kernel)
        return np.logaddexp.reduce(parts, axis=0)
