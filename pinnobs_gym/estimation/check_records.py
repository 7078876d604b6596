"""Records on which estimators are checked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System, initial_states, vector
from pinnobs_gym.simulation.truth import truth

NUM_SAMPLES = 40
"""Number of samples of the records on which estimators are checked."""


def short_record(estimator: BaseEstimator, batch: int = 3, *, irregular: bool = False) -> Record:
    """Simulate a short record of the estimator's system, with the benchmark's initial states and
    noise.

    An env is not used, because it would register a system that is only being checked.
    """
    system = estimator.system
    setup = system.setups["benchmark"]
    rng = np.random.default_rng(2)
    steps = np.full(NUM_SAMPLES - 1, float(setup.dt))
    if irregular:
        steps *= rng.uniform(0.3, 2.0, len(steps))
        steps = np.maximum(np.round(steps), 1.0) if system.discrete else steps
    t = np.append(0.0, np.cumsum(steps))
    x = truth(system, initial_states(system, setup, batch), t).swapaxes(0, 1)
    noise = system.noise(setup.noise_std, setup.process_noise)
    u = np.broadcast_to(system.input(t), (batch, len(t), system.nu)).copy()
    drawn = rng.standard_normal((len(t), batch, system.ny))
    y = system.h(t, x, u) + noise.outputs(t, drawn).swapaxes(0, 1)
    return Record(t, y, u, Prior.of(system, setup, batch))


def copied(record: Record) -> Record:
    """Return the record with arrays of its own."""
    prior = Prior(record.prior.mean.copy(), record.prior.cov.copy())
    t, y, u = record.t.copy(), record.y.copy(), record.u.copy()
    return replace(record, t=t, y=y, u=u, prior=prior)


def tolerated(
    run: Callable[[Record], Estimates], system: System, record: Record, tolerance: float
) -> float:
    """Return the difference over scale up to which estimates count as the same where they should
    be: the tolerance or, if that is more, ten times what a change of the prior's mean and of the
    outputs by a thousandth of it changes in the estimates.

    An observer that diverges on a plant amplifies rounding beyond any fixed tolerance, for which
    neither the observer's code nor the plant is wrong.
    """
    size, scale = 1e-3 * tolerance, vector(system.scale, system.nx, "scale")
    changed = copied(record)
    changed.prior.mean[:] += size * scale
    changed.y[:] *= 1 + size
    with np.errstate(all="ignore"):
        off = abs(system.state_residual(run(changed).xhat, run(record).xhat)) / scale
    return max(tolerance, 10 * float(np.nan_to_num(off, nan=0.0).max()))
