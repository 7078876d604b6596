"""A plant in other units: the same plant."""

import numpy as np
import pytest

from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.model import model_step_moments
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.rescaled import Units, rescaled
from pinnobs_gym.simulation.runge_kutta import longest_step
from pinnobs_gym.simulation.system import initial_states, output_scale
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

UNITS = Units(states=2.0**12, outputs=2.0**-7, time=2.0**4)


@pytest.mark.parametrize("plant", [ReverseDuffing(), InductionMotor()])
def test_it_is_a_sound_system(plant):
    check_system(type(rescaled(plant, UNITS)))


@pytest.mark.parametrize("plant", [ReverseDuffing(), InductionMotor()])
def test_its_truth_model_and_prior_are_the_plants(plant):
    system, setup = rescaled(plant, UNITS), plant.setups["benchmark"]
    own = system.setups["benchmark"]
    x0, t = initial_states(plant, setup, 3), 5 * setup.dt * np.arange(6)
    np.testing.assert_array_equal(initial_states(system, own, 3), UNITS.states * x0)
    expected = truth(plant, x0, t)
    found = truth(system, UNITS.states * x0, UNITS.time * t)
    np.testing.assert_allclose(found, UNITS.states * expected, rtol=1e-9)
    np.testing.assert_array_equal(output_scale(system), UNITS.outputs * output_scale(plant))
    prior, scaled = Prior.of(plant, setup, 2), Prior.of(system, own, 2)
    np.testing.assert_array_equal(scaled.mean, UNITS.states * prior.mean)
    np.testing.assert_array_equal(scaled.cov, UNITS.states**2 * prior.cov)
    assert longest_step(system) == UNITS.time * longest_step(plant)


def test_process_noise_of_a_step_is_the_plants():
    """A variance has the unit of the state squared, whatever the unit of time."""
    plant = ReverseDuffing()
    system, level = rescaled(plant, UNITS), (0.1, 0.2)
    scaled = [UNITS.process_noise * each for each in level]
    x = np.array([[0.5, -0.3]])
    _, F, Q = model_step_moments(plant, plant.noise(0.1, level), 0.0, 0.05, x)
    noise = system.noise(0.1 * UNITS.outputs, scaled)
    end = 0.05 * UNITS.time
    _, other, found = model_step_moments(system, noise, 0.0, end, UNITS.states * x)
    np.testing.assert_allclose(other, F, rtol=1e-12)
    np.testing.assert_allclose(found, UNITS.states**2 * Q, rtol=1e-12)
    np.testing.assert_allclose(noise.R(0.0), (0.1 * UNITS.outputs) ** 2, rtol=1e-12)


def test_levels_by_sample_keep_their_samples():
    plant = ReverseDuffing()
    level = SampledLevel(np.array([0.0, 0.05]), np.array([[[0.1], [0.4]]]))
    noise = rescaled(plant, UNITS).noise(UNITS.output_noise(level))
    for t, std in ((0.0, 0.1), (0.05, 0.4)):
        found = noise.R(UNITS.time * t)[0, 0, 0]
        np.testing.assert_allclose(found, (UNITS.outputs * std) ** 2, rtol=1e-12)
