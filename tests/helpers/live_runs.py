"""Online estimators and records of one plant, played sample by sample by `Live`."""

from dataclasses import replace
from functools import cache

import many_plants
import numpy as np
from kinds import trained, untrained
from linear import record_of
from quick_trainings import made

from pinnobs_gym import Live
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimation.takes import NotTaken
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.noise import SampledLevel

UNTRAINED = [n for n in untrained() if issubclass(ESTIMATORS.resolve(n), Estimator)]
TRAINED = [n for n in trained() if issubclass(ESTIMATORS.resolve(n), Estimator)]
ONLINE = [*UNTRAINED, *TRAINED]
SAMPLES = 30


@cache
def benchmark(name):
    """A system, its setup, and the first samples of an episode of which some outputs are
    missing."""
    source = EpisodeSource(name)
    record = record_of(source, 1).first_samples(SAMPLES)
    y = record.y.copy()
    y[0, [4, 5, 11]] = np.nan
    y[0, 8, 0] = np.nan
    return source.system, source.setup, replace(record, y=y)


def online(name, system="ReverseDuffing"):
    """An online estimator of a system, quickly trained if it has to be, and a record."""
    model, setup, record = benchmark(system)
    if name in TRAINED:
        return made(name), record
    return ESTIMATORS.resolve(name).for_setup(model, setup), record


def on_plant(name, plant):
    """An estimator that needs no training on one of `many_plants`, and a record; None if it does
    not take the plant."""
    system, record = plant(1)
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    try:
        return ESTIMATORS.resolve(name)(system, level), record
    except NotTaken:
        return None


def begun(estimator, record, **settings):
    """A live filter with the prior of a record."""
    return Live(estimator, record.prior.mean[0], record.prior.cov[0], **settings)


def samples(record, chosen=slice(None)):
    """Time, outputs and inputs of the samples of a record."""
    whole = zip(record.t.tolist(), record.y[0], record.u[0], strict=True)
    return list(whole)[chosen]


def expected(estimator, record):
    """The estimate, standard deviations and NIS of each sample by `Estimator.run`, in NumPy."""
    found = estimator.run(record)
    std, nis = [None] * record.num_samples, [None] * record.num_samples
    for k in range(record.num_samples):
        if found.P is not None:
            with np.errstate(invalid="ignore"):
                std[k] = np.sqrt(np.maximum(np.diagonal(found.P[0, k]), 0.0))
        present = np.isfinite(record.y[0, k])
        if found.innovation is not None and found.S is not None and present.any():
            e, S = found.innovation[0, k][present], found.S[0, k][np.ix_(present, present)]
            nis[k] = e @ np.linalg.inv(S) @ e
    return found.xhat[0], std, nis


def assert_as_expected(estimates, wanted, first=0):
    """Estimates are those wanted to the last bit, and NaN where these are; the NIS to rounding."""
    xhat, std, nis = wanted
    for k, estimate in enumerate(estimates, first):
        np.testing.assert_array_equal(estimate.xhat, xhat[k])
        assert (estimate.std is None) == (std[k] is None)
        if std[k] is not None:
            np.testing.assert_array_equal(estimate.std, std[k])
        assert (estimate.nis is None) == (nis[k] is None)
        if nis[k] is not None:
            np.testing.assert_allclose(estimate.nis, nis[k], rtol=1e-6, atol=1e-9)


PLANTS = many_plants.PLANTS
