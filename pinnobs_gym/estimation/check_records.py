"""Records on which estimators are checked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import initial_states
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
