"""The set of initial states of a setup: its mean and covariance, and states of it."""

from __future__ import annotations

import pickle
from itertools import product

import numpy as np

from pinnobs_gym.simulation.cached import cached_by_plant
from pinnobs_gym.simulation.start_law import Box, Points, StartLaw
from pinnobs_gym.simulation.system import Setup, System, vector

_POINTS = 2**22
"""Number of points of the quadrature of a restricted set."""
_DRAWS = 2**21
"""Number of states drawn from a law other than a box that is restricted."""
_CHUNK = 2**16
"""Number of them evaluated at a time."""
_REFLECTED = 3
"""Largest number of states with which they are reflected in each axis."""


def prior_moments(system: System, setup: Setup) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean x̂₀ (nx,) and the covariance P₀ (nx, nx) of a setup's prior, in state units:
    the setup's own or, where it has none, those of its initial set (`_law_moments`)."""
    nx = system.nx
    mean = None if setup.xhat0 is None else vector(setup.xhat0, nx, "xhat0")
    cov = None if setup.P0 is None else np.array(setup.P0, dtype=float)
    if cov is not None and cov.shape != (nx, nx):
        raise ValueError(f"P0 has shape {cov.shape}; expected ({nx}, {nx})")
    if mean is None or cov is None:
        own_mean, own_cov = _law_moments(system, setup.start(nx))
        mean = own_mean.copy() if mean is None else mean
        cov = own_cov.copy() if cov is None else cov
    return mean, cov


def _law_moments(system: System, law: StartLaw) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (nx,) and the covariance (nx, nx) of the admissible states of a law.

    Raises:
        ValueError: in one line, if no state is admissible.
    """
    if isinstance(law, Box):
        return set_moments(system, tuple(law.low), tuple(law.high))
    if isinstance(law, Points):
        states = np.array(law.states, dtype=float)
        kept = states[np.asarray(system.admissible(states))]
        if not len(kept):
            raise ValueError(f"{type(system).__name__}: no state of {law.states} is admissible")
        law = Points(tuple(map(tuple, kept.tolist())))
    elif not law.fixed and (
        type(system).admissible is not System.admissible or system.state_box is not None
    ):
        return _drawn_moments(system, pickle.dumps(law))
    return law.mean, law.cov


@cached_by_plant
def _drawn_moments(system: System, pickled: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (nx,) and the covariance (nx, nx) of the admissible ones of 2²¹ states drawn
    from a law with a fixed seed. The error relative to the standard deviations is of the order of
    1e-3. Directions in which the law has no variance have none here but for rounding. The result is
    cached; its arrays are read-only.

    Raises:
        ValueError: in one line, if no state is admissible.
    """
    law: StartLaw = pickle.loads(pickled)
    rng, middle = np.random.default_rng(0), law.mean
    number, first, second = 0, np.zeros(system.nx), np.zeros((system.nx, system.nx))
    for _ in range(_DRAWS // _CHUNK):
        x = law.draw(rng, _CHUNK)
        off = x[np.asarray(system.admissible(x))] - middle
        number += len(off)
        first += off.sum(axis=0)
        second += np.einsum("ni,nj->ij", off, off)
    if not number:
        raise ValueError(
            f"{type(system).__name__}: none of {_DRAWS} states is admissible; {law.sentence}"
        )
    mean = first / number
    cov = second / number - np.outer(mean, mean)
    mean = middle + mean
    for moments in (mean, cov):
        moments.flags.writeable = False
    return mean, cov


@cached_by_plant
def set_moments(
    system: System, low: tuple[float, ...], high: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (nx,) and the covariance (nx, nx) of initial states that are uniform in a
    box, restricted to `System.admissible`.

    Both are exact if `System.admissible` is not overridden. Otherwise they are averages over the
    admissible ones of 2²² points of the box: a Sobol' sequence, scrambled with a fixed seed, and
    its reflections about the middle of the box in each axis, so that moments which vanish by
    symmetry are exactly zero. With more than three states, only the reflection through the middle
    is added. For the systems of the package, the error relative to the standard deviations is below
    1e-4. The result is cached; its arrays are read-only.

    Args:
        system: the system.
        low: lower corner of the box, nx numbers in state units.
        high: upper corner of the box.

    Raises:
        ValueError: in one line, if no point is admissible.
    """
    middle, half = (np.array(high) + low) / 2, (np.array(high) - low) / 2
    if type(system).admissible is System.admissible:
        mean, cov = np.zeros(system.nx), np.eye(system.nx) / 3
    else:
        mean, cov = _moments(system, middle, half)
    mean, cov = middle + half * mean, half[:, None] * cov * half
    for moments in (mean, cov):
        moments.flags.writeable = False
    return mean, cov


def _moments(system: System, middle: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and covariance of z, where x = middle + half·z is uniform in the admissible part
    of the box with this middle (nx,) and these half sides (nx,)."""
    from scipy.stats.qmc import Sobol  # takes long to import

    nx = system.nx
    if nx <= _REFLECTED:
        signs = np.array(list(product((1.0, -1.0), repeat=nx)))
    else:
        signs = np.array([[1.0], [-1.0]])
    sequence = Sobol(nx, scramble=True, rng=0)
    number, first, second = 0, np.zeros(nx), np.zeros((nx, nx))
    for _ in range(_POINTS // (_CHUNK * len(signs))):
        points = 2 * sequence.random(_CHUNK) - 1
        for sign in signs:
            z = sign * points
            z = z[np.asarray(system.admissible(middle + half * z))]
            number += len(z)
            first += z.sum(axis=0)
            second += z.T @ z
    if not number:
        raise ValueError(
            f"{type(system).__name__}: none of {_POINTS} states of the box is admissible"
        )
    mean = first / number
    cov = second / number - np.outer(mean, mean)
    # What is left of sums that cancel is rounding error.
    return np.where(abs(mean) < 1e-9, 0.0, mean), np.where(abs(cov) < 1e-9, 0.0, cov)
