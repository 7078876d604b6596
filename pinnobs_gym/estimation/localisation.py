"""Localisation of an ensemble's covariances: correlations decrease with distance."""

from __future__ import annotations

import numpy as np

from pinnobs_gym.simulation.system import System


def gaspari_cohn(distance: np.ndarray, radius: float) -> np.ndarray:
    """Return the correlations, 1 at distance 0 and 0 from the radius on, of the fifth-order
    piecewise rational function of Gaspari & Cohn (1999, equation 4.10), whose c is half the radius.

    The matrix of the correlations between points of a line, a plane or space is positive
    semidefinite, and so is the product, entry by entry, of it and a covariance.
    """
    z = 2 * np.asarray(distance, dtype=float) / radius
    near = 1 + z**2 * (-5 / 3 + z * (5 / 8 + z * (1 / 2 - z / 4)))
    far = np.where(z > 0, z, 1.0)  # it is not evaluated at 0
    tail = 4 - far * (5 - far * (5 / 3 + far * (5 / 8 - far * (1 / 2 - far / 12)))) - 2 / (3 * far)
    return np.where(z <= 1, near, np.where(z < 2, tail, 0.0))


def tapers(system: System, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the correlations by `gaspari_cohn` between states and outputs (nx, ny), and between
    outputs (ny, ny), of a system that declares its `System.distances`.

    Raises:
        ValueError: in one line, if it declares none, or they are of the wrong size.
    """
    name, distances = type(system).__name__, system.distances()
    if distances is None:
        raise ValueError(f"localisation={radius:g}, but {name} declares no distances()")
    for distance, shape in zip(
        distances, ((system.nx, system.ny), (system.ny, system.ny)), strict=True
    ):
        if np.shape(distance) != shape or not (np.asarray(distance) >= 0).all():
            raise ValueError(
                f"{name}.distances() returns an array of shape {np.shape(distance)}; expected "
                f"numbers of at least 0 in shape {shape}"
            )
    states, outputs = (gaspari_cohn(distance, radius) for distance in distances)
    return states, outputs
