"""A test of whether innovations can be told from the inputs before them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pinnobs_gym.logs.innovation_tests import bounded, effective_number

_LAGS = 5
"""Number of rows before an innovation whose inputs are tried."""
_PER_LAG = 10
"""Least number of innovations per coefficient."""
_RANK = 1e-6
"""Singular value of the inputs, relative to the largest, below which a combination is left out."""


@dataclass(frozen=True)
class Driven:
    """How well an input tells the innovations of an output."""

    input_name: str
    """Name of the input that tells them best; empty if none can be tried."""
    value: float
    """Multiple correlation with it at the rows before, 0 to 1; near 0 if the model is right."""
    chance: float
    """Probability of one so large, over all inputs."""


def driven_by(
    values: np.ndarray, rows: np.ndarray, u: np.ndarray, names: tuple[str, ...]
) -> Driven:
    """Test whether inputs tell the innovations that follow them.

    Innovations of a right model are independent of all that was known before, inputs included
    (Ljung 1999, "System Identification", section 16.6, for residuals), also where a controller
    computes them from the outputs. With the multiple correlation r of n independent innovations
    with the inputs at m rows before, nr² follows χ² with m degrees of freedom for large n. For n
    stands `effective_number` of the innovations, as two slow signals are easily alike.

    Args:
        values: normalised innovations of an output, shape (n,).
        rows: their rows, shape (n,).
        u: inputs at all rows, shape (num_samples, nu).
        names: names of the inputs.
    """
    from scipy.special import gammaincc

    kept = rows >= _LAGS
    values, rows = bounded(values[kept]), rows[kept]
    found = [Driven("", 0.0, 1.0)]
    if len(rows) < _PER_LAG * _LAGS or not values.any():
        return found[0]
    number = effective_number(values)
    for name, column in zip(names, (u - u.mean(axis=0)).T, strict=True):
        past = np.stack([column[rows - lag] for lag in range(1, _LAGS + 1)], axis=1)
        weights, _, rank, _ = np.linalg.lstsq(past, values, rcond=_RANK)
        part = float(np.sum((past @ weights) ** 2) / np.sum(values**2))
        chance = float(gammaincc(rank / 2, number * part / 2)) if rank else 1.0
        found.append(Driven(name, part**0.5, min(1.0, len(names) * chance)))
    return max(found, key=lambda driven: driven.value)
