"""Plants with random equations in compiled code and in NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from compiled_plants import by_numpy, compiled
from fake_compilers import needs_compiler
from random_plants import random_case

from pinnobs_gym.estimation.compiled import compiled_filter
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.noise import AssumedNoise

pytestmark = needs_compiler
FIELDS = RecursiveEstimator.computes


def assert_near(found, expected):
    np.testing.assert_array_equal(np.isfinite(found), np.isfinite(expected))
    size = np.nan_to_num(abs(expected)).max(initial=1e-300)
    assert np.nan_to_num(abs(found - expected)).max(initial=0.0) <= 1e-9 * size


@pytest.mark.parametrize(
    "seed", [*range(6), *(pytest.param(k, marks=pytest.mark.slow) for k in range(6, 12))]
)
def test_filters(seed):
    kind = (EKF, UKF, CKF)[seed % 3]
    system, record = random_case(seed, 5, 30, largest=3)
    estimator = kind(system)
    assert estimator.compiled is not None, compiled_filter(estimator)
    other = replace(estimator)
    vars(other)["compiled"] = None
    with np.errstate(all="ignore"):
        found, expected = estimator.run(record), other.run(record)
    for name in FIELDS:
        assert_near(getattr(found, name), getattr(expected, name))
    system, record = random_case(seed, 3, 30, largest=3)
    with np.errstate(all="ignore"):
        part = kind(system).run(record)
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(part, name), getattr(found, name)[:3])


@pytest.mark.parametrize(
    "seed", [20, 21, *(pytest.param(k, marks=pytest.mark.slow) for k in (22, 23))]
)
def test_steps_of_the_model(seed):
    system, record = random_case(seed, 9, 5, largest=4)
    noise, x = AssumedNoise.of(system, system.noise(None, None), 0.05), record.prior.mean

    def call():
        results = []
        for k in range(3):
            t0, t1 = record.t[[k, k + 2]]
            u0, u1 = record.u[:, k], record.u[:, k + 2]
            results += [model_step(system, t0, t1, x, u0, u1)]
            results += model_step_moments(system, noise, t0, t1, np.stack([x, 1.1 * x]), u0, u1)
        return results

    for expected, found in zip(by_numpy(call), compiled("model", system, call), strict=True):
        assert_near(found, expected)
