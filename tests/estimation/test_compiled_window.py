"""Moving windows in compiled code against the same in NumPy, which is the reference."""

import pickle
from dataclasses import replace

import many_plants
import numpy as np
import pytest
from agreement import assert_near, assert_same
from fake_compilers import needs_compiler
from linear import Linear, linear_record, record_of

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.compiled_window import compiled_window
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor

pytestmark = needs_compiler
EXACT = [(plant, 0.0) for plant in many_plants.PLANTS if plant is not many_plants.escape]
NOISY = [(plant, 0.05) for plant in many_plants.PLANTS]


def in_numpy(estimator):
    """The same estimator without compiled code."""
    other = replace(estimator)
    vars(other)["compiled"] = None
    return other


def made(system, record, noise, **options):
    """An estimator that is told of this process noise: without any, the states of a window follow
    from its first one."""
    level = None if record.noise_std is None else SampledLevel(record.t, record.noise_std)
    estimator = MHE(system, level, noise, **options)
    assert estimator.compiled is not None, compiled_window(estimator)
    return estimator


@pytest.mark.parametrize("name", SYSTEMS.classes())
@pytest.mark.parametrize("options", [{}, {"window": 4, "steps": 3}, {"window": 1}])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_it_agrees_with_numpy_on_each_system(name, options, noise):
    source = EpisodeSource(name)
    record = record_of(source, 2).first_samples(40 if noise == 0 else 20)
    estimator = made(source.system, record, noise, **options)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@pytest.mark.parametrize(("plant", "noise"), [*EXACT, *NOISY])
def test_it_agrees_with_numpy(plant, noise):
    """Irregular times, missing outputs, maps, inputs, angles, bounds, tables, wide priors."""
    system, record = plant(7)
    estimator = made(system, record, noise, window=5)
    assert_near(estimator.run(record), in_numpy(estimator).run(record))


@pytest.mark.parametrize("plant", [many_plants.cart, many_plants.bounded_reactor])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_row_is_the_same_alone_and_in_any_batch(plant, noise):
    system, record = plant(9)
    whole = made(system, record, noise, window=5).run(record)
    for rows in (np.arange(1), np.arange(3, 9), np.array([0, 2, 4, 6, 8])):
        part = record.rows(rows)
        found = made(system, part, noise, window=5).run(part)
        for name in ("xhat", "P", "innovation", "S"):
            np.testing.assert_array_equal(getattr(found, name), getattr(whole, name)[rows])


def test_a_row_with_a_very_wide_prior_is_the_same_alone_and_in_any_batch():
    """It is processed in NumPy, alone from the first sample on, in a batch from a part of it."""
    system, record = many_plants.bounded_reactor(3)
    cov = record.prior.cov * np.array([1.0, 1e10, 1.0])[:, None, None]
    record = replace(record, prior=Prior(record.prior.mean, cov))
    whole = made(system, record, 0.05, window=3).run(record)
    part = record.rows(np.array([1]))
    found = made(system, part, 0.05, window=3).run(part)
    for name in ("xhat", "P", "innovation", "S"):
        np.testing.assert_array_equal(getattr(found, name), getattr(whole, name)[1:2])


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_either_goes_on_from_a_state_of_the_other(noise):
    record = linear_record(3)
    estimator = made(Linear(), record, noise, window=4)
    other = in_numpy(estimator)
    whole = other.run(record)
    for first, second in ((estimator, other), (other, estimator)):
        state = first.reset(record.prior)
        for k in range(record.num_samples):
            own = first if k < 8 else second
            state = own.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
            np.testing.assert_allclose(state.xhat, whole.xhat[:, k], rtol=1e-9, atol=1e-12)
        state = pickle.loads(pickle.dumps(state))
        np.testing.assert_allclose(state.xhat, whole.xhat[:, -1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_window_over_the_record_is_the_kalman_filter(noise):
    """Full information of a linear plant is what the filter has."""
    record = linear_record(2)
    options = {"process_noise": noise, "assumed_noise": 0.0}
    estimator = MHE(Linear(), **options, window=100)
    assert estimator.compiled is not None
    found, expected = estimator.run(record), EKF(Linear(), **options).run(record)
    np.testing.assert_allclose(found.xhat, expected.xhat, rtol=1e-8, atol=1e-10)
    for name in ("P", "S"):
        a, b = getattr(found, name), getattr(expected, name)
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_inputs_that_the_plant_does_not_have_are_refused(noise):
    record = record_of(EpisodeSource("InductionMotor"), 1)
    estimator = made(InductionMotor(), record, noise)
    state = estimator.reset(record.prior)
    for k in range(2):
        with pytest.raises(ValueError, match=r"is not that of InductionMotor\.input"):
            estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k] + 1.0)
        state = estimator.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
    with pytest.raises(ValueError, match="expected at most 100000 between two samples"):
        estimator.update(state, 1e9, record.y[:, 2], InductionMotor().input(np.array([1e9])))


def test_runs_in_compiled_code_are_the_same_again():
    estimator, record = MHE(Linear(), window=4), linear_record(3)
    assert_same(estimator.run(record), estimator.run(record))
