"""The particle filter where process noise is small, and where it cannot be trusted."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from angles import Compass
from benchmarks.plants.motion import Growth, grid_means, growth_runs
from benchmarks.plants.radar import LOST, tracks
from circle import Pair, Turns, circle_record

from pinnobs_gym.estimation.regularisation import Sample, shrinkage_of, shrinkages
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix

DT, NOISE = 0.1, 0.1


@dataclass(frozen=True)
class Walk(System):
    """A random walk that is measured."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {
        "benchmark": Setup(
            x0_low=(0.0,),
            x0_high=(0.0,),
            duration=20.0,
            dt=DT,
            noise_std=NOISE,
            xhat0=(0.0,),
            P0=independent(1.0),
        )
    }

    def f(self, t, x, u):
        return 0 * x

    def h(self, t, x, u):
        return x + 0.0

    def f_jacobian(self, t, x, u):
        return matrix(x, ((0,),))

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1,),))


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def walk_record(std, runs=50, samples=200):
    """Return random walks (runs, samples) and the record of them."""
    rng = np.random.default_rng(1)
    steps = std * np.sqrt(DT) * rng.standard_normal((runs, samples))
    steps[:, 0] = rng.standard_normal(runs)
    x = np.cumsum(steps, axis=1)
    y = (x + NOISE * rng.standard_normal(x.shape))[..., None]
    prior = Prior(np.zeros((runs, 1)), np.ones((runs, 1, 1)))
    return x, Record(DT * np.arange(samples), y, np.zeros((runs, samples, 0)), prior)


def kalman(record, std):
    """Return the means (runs, samples) and the variances (samples,) of the Kalman filter."""
    mean, variance, means, variances = np.zeros(record.batch), 1.0, [], []
    for k in range(record.num_samples):
        variance += DT * std**2 if k else 0.0
        gain = variance / (variance + NOISE**2)
        mean = mean + gain * (record.y[:, k, 0] - mean)
        variance *= 1 - gain
        means.append(mean)
        variances.append(variance)
    return np.stack(means, axis=1), np.array(variances)


@pytest.mark.parametrize("std", [0.0, 1e-4, 1e-3, 1e-2, 0.1, 1.0])
def test_of_a_random_walk_it_has_the_covariance_of_the_kalman_filter(std, said):
    x, record = walk_record(std)
    run = ParticleFilter(Walk(), process_noise=std).run(record)
    assert run.P is not None
    mean, variance = kalman(record, std)
    late = slice(100, None)
    off = (run.xhat[..., 0] - mean)[:, late] / np.sqrt(variance[late])
    np.testing.assert_allclose(run.P[:, late, 0, 0].mean(), variance[late].mean(), rtol=0.06)
    assert np.mean(off**2) < 0.25  # what is left to chance
    assert np.mean((run.xhat[..., 0] - x)[:, late] ** 2 / run.P[:, late, 0, 0]) < 1.3
    assert not said()


def test_kernels_give_what_process_noise_lacks():
    """Of a walk, q is the ratio of Q to the variance that one more sample would leave."""
    system, P = Walk(), np.array([[[0.3**2]]])
    local = 1 / (1 / P[0, 0, 0] + 1 / NOISE**2)
    usual, wide = (1 - shrinkage_of(each) ** 2 for each in (0.95, 0.7))
    for q in (0.0, 0.3 * usual, 3 * usual):
        noise = ParticleFilter(system, process_noise=np.sqrt(q * local / DT)).noise
        sample = Sample.of(noise, 0.0, DT, np.zeros((1, 1)), np.zeros((1, 0)))
        args = system, sample, np.zeros((1, 1)), P
        share = 1 - shrinkages(*args, tempering=False) ** 2
        np.testing.assert_allclose(share, max(usual - q, 0.0), atol=1e-12)
        share = 1 - shrinkages(*args, tempering=True) ** 2
        np.testing.assert_allclose(share, max(wide * (1 - q / usual), usual), atol=1e-12)


def test_a_noise_in_some_directions_leaves_kernels_in_the_others():
    system, P = Compass(), np.array([[[0.1, 0.03], [0.03, 0.04]]])
    noise = ParticleFilter(system, process_noise=(0.0, 10.0)).noise
    sample = Sample.of(noise, 0.0, 0.1, np.full((1, 1), np.nan), np.zeros((1, 0)))
    a = shrinkages(system, sample, np.zeros((1, 2)), P, tempering=False)
    np.testing.assert_allclose(a, shrinkage_of(0.95), rtol=1e-9)


@pytest.mark.slow
def test_it_loses_no_track_of_a_radar():
    """Without kernels for the small noise of the turn rate, it loses 12 of 20."""
    assert (tracks("particle") <= LOST).all()


@pytest.mark.slow
def test_the_growth_model_is_near_the_filter_on_a_grid():
    path, record = growth_runs()
    least = np.sqrt(np.mean((grid_means(record.y[..., 0]) - path[..., 0]) ** 2))
    found = ParticleFilter(Growth(), particles=500).run(record).xhat
    assert np.sqrt(np.mean((found - path) ** 2)) / least < 1.02


def test_it_is_said_once_where_few_particles_are_left(said):
    for std in (30.0, 100.0):
        _, record = walk_record(std, runs=10, samples=60)
        ParticleFilter(Walk(), process_noise=std).run(record)
    (line,) = said()
    assert line.startswith("particle filter on Walk: outputs leave fewer than 5 effective")


def test_it_is_said_where_an_output_does_not_tell_the_turn_of_a_state(said):
    _, record = circle_record(Pair(), 3.0, runs=20)
    ParticleFilter(Pair()).run(record)
    assert not said()
    _, record = circle_record(Turns(), 3.0, runs=20)
    ParticleFilter(Turns()).run(record)
    (line,) = said()
    assert line.startswith("particle on Turns: output y repeats")
