"""What a live filter begins with: its checks, its prior, and the first steps of its estimator."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import numpy as np

from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimator, State
from pinnobs_gym.estimation.live_estimate import Estimate
from pinnobs_gym.estimation.live_sample import Sample
from pinnobs_gym.estimation.live_steps import ByNumpy, InBuffers, Point, Steps
from pinnobs_gym.simulation.plant_form import first_row
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.start_law import check_covariance
from pinnobs_gym.simulation.system import System, vector
from pinnobs_gym.simulation.values import is_number, is_whole, shortly


def check_online(estimator: Any) -> None:
    """Check that an estimator is an online one of one plant.

    Raises:
        ValueError: in one line, if it is offline, changes in place, or has parameters by row.
        TypeError: in one line, if it is no estimator.
    """
    if not isinstance(estimator, BaseEstimator):
        raise TypeError(f"{estimator!r} is no estimator; expected an online one, such as EKF(...)")
    if not isinstance(estimator, Estimator):
        raise ValueError(
            f"{estimator.label} is offline: it needs the whole record for each estimate; expected "
            "an online estimator, such as ekf"
        )
    if isinstance(estimator, PerEpisode):
        raise ValueError(
            f"{estimator.label} is an adapter of objects that change in place, so that no sample "
            "could be taken back; expected an Estimator"
        )
    system = estimator.system
    one = first_row(system)
    for name in (f.name for f in fields(system)):
        value = getattr(system, name)
        if np.shape(value) != np.shape(getattr(one, name)):
            raise ValueError(
                f"{name} of {type(system).__name__} has {len(value)} values; expected that of one "
                "plant"
            )


def check_settings(late: Any, ring: Any, longest_gap: Any) -> None:
    """Check the settings of a live filter.

    Raises:
        ValueError: in one line that names the value and what was expected.
    """
    if late not in ("refuse", "replay"):
        raise ValueError(f"late={late!r}; expected 'refuse' or 'replay'")
    if not is_whole(ring, 1):
        raise ValueError(f"ring={shortly(ring)}; expected a whole number of at least 1 sample")
    if not (is_number(longest_gap) and longest_gap > 0):
        raise ValueError(f"longest_gap={shortly(longest_gap)}; expected a positive number of s")


def prior_of(system: System, xhat0: Any, P0: Any) -> Prior:
    """Return the prior of one plant; the arguments are those of `Live`."""
    mean = None if xhat0 is None else vector(xhat0, system.nx, "xhat0")
    prior = Prior.of(system, system.setups["benchmark"], 1, mean)
    if P0 is None:
        return prior
    if np.shape(P0) != (system.nx, system.nx):
        raise ValueError(
            f"P0 has shape {np.shape(P0)}; expected a covariance, (nx, nx)="
            f"{(system.nx, system.nx)}; independent(*std) makes one from standard deviations"
        )
    check_covariance(np.asarray(P0).tolist(), "P0")
    return Prior(prior.mean, np.array([P0], dtype=float))


def prepare(estimator: Estimator, steps: Steps, begun: State, dt: float) -> None:
    """Try the first steps of an estimator, so that nothing is left to be imported, compiled or
    designed at a sample. The outputs are those of the prior's mean, and missing ones."""
    system = estimator.system
    # Compiled code leaves some samples to NumPy.
    ways = [steps, ByNumpy(estimator)] if type(steps) is InBuffers else [steps]
    for way in ways:
        point: Point = begun
        for k, missing in enumerate((False, False, True, False)):
            t = k * dt
            u = np.asarray(system.input(np.array([t])))
            with np.errstate(all="ignore"):
                y = np.asarray(system.h(t, begun.xhat, u))
            y = np.where(np.isfinite(y) & (not missing), y, np.nan)
            sample = Sample(t, y[0].tolist(), u[0].tolist())
            point = way(point, sample)
            repr(Estimate(point, sample.y))
