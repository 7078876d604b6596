"""Outputs and states that are angles: estimators on a compass and on a radar."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from angles import TURN, Compass, Unwrapped, north_record
from benchmarks.plants.radar import LOST, RUNS, Radar, tracks
from kinds import untrained
from small_trainings import constant_gain

from pinnobs_gym.envs.actions import form_of
from pinnobs_gym.estimation.checks import ESTIMATOR_CHECKS
from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.kkl import KKLSupervised
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.record import Prior

SETUP = Compass.setups["benchmark"]


@pytest.mark.parametrize("name", untrained())
def test_a_compass_gives_the_estimates_of_a_sensor_that_counts_turns(name):
    """Where the sensor without jumps needs no wrapping at all."""
    _, *records = north_record(Compass())
    wrapped, plain = (record.first_samples(120) for record in records)
    cls = ESTIMATORS.resolve(name)
    found = cls.for_setup(Compass(), SETUP).run(wrapped)
    expected = cls.for_setup(Unwrapped(), SETUP).run(plain)
    off = Compass().state_residual(found.xhat, expected.xhat)
    np.testing.assert_allclose(off, 0.0, atol=1e-9)
    for part in ("P", "innovation", "S"):
        if getattr(expected, part) is not None:
            np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-9)


@pytest.mark.parametrize("name", untrained())
@pytest.mark.parametrize("system", [Compass, Radar])
def test_outputs_moved_by_whole_periods_change_no_estimate(system, name):
    cls = ESTIMATORS.resolve(name)
    setup = system.setups["benchmark"]
    if "process_noise" not in cls.takes:
        setup = replace(setup, process_noise=0.0)
    ESTIMATOR_CHECKS["periods"](cls.for_setup(system(), setup))


def test_the_check_finds_an_estimator_that_takes_angles_for_numbers():
    @dataclass(frozen=True)
    class Plain(RecursiveEstimator):
        """It adds half of the difference."""

        def reset(self, prior):
            return State(prior.mean)

        def predict(self, state, t, u):
            return State(state.xhat, state.t, state.u)

        def correct(self, state, t, y, u):
            error = np.where(np.isnan(y), 0.0, y - self.system.h(t, state.xhat, u))
            return State(state.xhat + [0.5, 0.0] * error, t, u)

    with pytest.raises(CheckFailed, match="periods: xhat with compass moved by whole periods"):
        ESTIMATOR_CHECKS["periods"](Plain(Compass()))
    ESTIMATOR_CHECKS["periods"](Plain(Unwrapped()))


@pytest.mark.parametrize("cls", [UKF, EnKF, ParticleFilter])
def test_points_on_both_sides_of_the_end_have_the_mean_between_them(cls):
    """A prior about π: half of all points measure almost −π. The Kalman filter of the heading is
    exact."""
    system, std, noise = Compass(), 0.3, 0.05
    _, record, _ = north_record(system, batch=2)
    prior = Prior(np.tile([np.pi, 0.0], (2, 1)), np.tile(np.diag([std**2, 0.01]), (2, 1, 1)))
    first = replace(record.first_samples(1), prior=prior)
    run = cls.for_setup(system, SETUP).run(first)
    gain = std**2 / (std**2 + noise**2)
    expected = np.pi + gain * system.output_residual(first.y[:, 0], np.full((2, 1), np.pi))[:, 0]
    off = system.state_residual(run.xhat[:, 0], np.stack([expected, np.zeros(2)], axis=-1))
    np.testing.assert_allclose(off[:, 0], 0.0, atol=0.02)
    np.testing.assert_allclose(run.P[:, 0, 0, 0], gain * noise**2, rtol=0.3)
    np.testing.assert_allclose(run.S[:, 0, 0, 0], std**2 + noise**2, rtol=0.15)


@pytest.mark.parametrize("cls", [EnKF, ParticleFilter])
def test_points_that_reach_a_heading_from_both_sides_are_the_same_states(cls):
    """A heading that is not known at all: points turn to it by the shorter way, left or right."""
    system = Compass()
    heading, record, _ = north_record(system)
    record, heading = record.rows(slice(0, 2)).first_samples(20), heading[:2, 19]
    prior = Prior(np.zeros((2, 2)), np.tile(np.diag([4.0, 0.01]), (2, 1, 1)))
    run = cls.for_setup(system, SETUP).run(replace(record, prior=prior))
    off = system.state_residual(run.xhat[:, -1], np.stack([heading, np.zeros(2)], axis=-1))
    assert (abs(off[:, 0]) < 0.15).all()
    assert (run.P[:, -1, 0, 0] < 0.1**2).all()


def test_the_replay_of_pinn_obs_interpolates_angles_the_shorter_way():
    _, wrapped, plain = north_record(Compass())
    L = np.array([[2.0], [1.0]])
    found, expected = (
        PinnObsReplay(system, trained=constant_gain(system, L, record.rows(slice(0, 1))))
        .run(record)
        .xhat
        for system, record in ((Compass(), wrapped), (Unwrapped(), plain))
    )
    np.testing.assert_allclose(Compass().state_residual(found, expected), 0.0, atol=1e-9)


def test_a_kkl_observer_of_an_angle_is_refused():
    with pytest.raises(ValueError, match="KKLSupervised does not take Compass: it takes no out"):
        KKLSupervised(Compass(), trained=None)  # pyright: ignore[reportArgumentType]


def test_features_of_agents_are_those_of_the_angle_and_angles_are_not_clipped():
    form = form_of("gain", Compass(), SETUP)
    now, u = np.zeros(2), np.zeros((2, 0))
    mean = np.array([[3.0, 0.1], [3.0 + 20 * TURN, 0.1]])
    memory = form.begin(mean, now, u)
    features, memory = form.observe(memory, now, np.array([[-3.1], [-3.1]]), u)
    np.testing.assert_allclose(features[0], features[1], atol=1e-12)
    S = SETUP.P0[0][0] + 0.05**2
    expected = np.arcsinh((TURN - 6.1) / np.sqrt(S))
    np.testing.assert_allclose(features[0, 0], expected, rtol=1e-6)
    after = form.act(memory, np.zeros((2, 2))).xhat
    np.testing.assert_array_equal(after, mean)


@pytest.mark.parametrize("name", ["ekf", "ukf", "enkf", "mhe"])
def test_a_radar_loses_no_track_and_finds_the_position(name):
    """The median over the tracks of the root mean square error in their second halves. With
    bearings taken for numbers, these filters lose 7, 2, 1 and 8 of the 20 tracks."""
    error = tracks(name)
    assert error.shape[0] == RUNS
    assert (error <= LOST).all()
    assert np.median(np.sqrt((error**2).mean(axis=1))) <= 1.1
