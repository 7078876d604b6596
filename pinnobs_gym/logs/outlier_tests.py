"""Normalised innovations, or residuals, far beyond the others."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.innovation_tests import effective_number, robust_std

FAR = 1e-3
"""Probability of a value beyond the bound from which on it may be an outlier."""
_NEAR = 3
"""Number of rows between two echoes of an outlier, at most."""


@dataclass(frozen=True)
class Outliers:
    """Values far beyond the others."""

    share: float
    """Their share; `FAR` is expected."""
    single: float
    """Share of those that are no echo of one before."""
    memory: float
    """Number of samples over which these come together, n over `effective_number`; 1 if each comes
    by itself."""
    largest: float
    """Size of the largest, in standard deviations."""
    worst: int
    """Index of the largest."""
    first: int
    """Index of the first."""
    last: int
    """Index of the last."""
    chance: float
    """Probability of so many of them, or more, among independent normal values."""


def outliers_of(values: np.ndarray) -> Outliers:
    """Return the share of values (n,) that are, by their robust standard deviation, beyond the
    bound of a normal value with probability `FAR`, of which the number is binomial."""
    from scipy.special import bdtrc, ndtri

    far = abs(values) > float(ndtri(1 - FAR / 2)) * robust_std(values)
    rows = np.flatnonzero(far)
    if not len(rows):
        return Outliers(0.0, 0.0, 1.0, 0.0, 0, 0, 0, 1.0)
    chance = float(bdtrc(len(rows) - 1, len(values), FAR))
    single = far & ~_echoes(values, rows)
    memory = len(values) / effective_number(single)
    worst, ends = int(abs(values).argmax()), (int(rows[0]), int(rows[-1]))
    largest, shares = float(abs(values[worst])), (float(far.mean()), float(single.mean()))
    return Outliers(*shares, memory, largest, worst, *ends, chance)


def _echoes(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return which values (n,) are echoes, bool (n,), among those far beyond the others, at rows
    (m,). A wrong output draws the estimate towards itself, so that innovations have the opposite
    sign for a while, each smaller than the first."""
    echoes, first = np.zeros(len(values), dtype=bool), rows[0]
    for before, row in itertools.pairwise(rows):
        near = row - before <= _NEAR
        echoes[row] = near and -1 < values[row] / values[first] < 0
        first = first if echoes[row] else row
    return echoes
