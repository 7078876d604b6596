"""Filters of points where the model or the output is not defined at some of them."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from array_api_compat import array_namespace

from pinnobs_gym.estimation.notices import say_once
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent

NOISE = 0.05


def setup(mean, std):
    box = ((mean - std,), (mean + std,))
    return Setup(*box, duration=3.0, dt=0.1, noise_std=NOISE, xhat0=(mean,), P0=independent(std))


@dataclass(frozen=True)
class LogSensor(System):
    """ẋ = −x, of which the logarithm is measured: not defined below zero."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {"benchmark": setup(1.0, 0.4)}

    def f(self, t, x, u):
        return -x

    def h(self, t, x, u):
        return array_namespace(x).log(x)

    def h_jacobian(self, t, x, u):
        return (1 / x)[..., None]


@dataclass(frozen=True)
class Explosive(LogSensor):
    """ẋ = 20x³, which overflows where |x| is large; x is measured."""

    setups = {"benchmark": setup(0.0, 0.4)}

    def f(self, t, x, u):
        return 20 * x**3

    def h(self, t, x, u):
        return 1.0 * x

    def h_jacobian(self, t, x, u):
        return np.ones((*x.shape, 1))


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.estimation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def log_record(shift=0.0, batch=1):
    t = np.arange(0, 30) * 0.1
    noise = NOISE * np.random.default_rng(0).standard_normal((batch, 30))
    y = (shift - t + noise)[..., None]
    system = LogSensor()
    prior = Prior.of(system, system.setups["benchmark"], batch)
    return Record(t, y, np.zeros((batch, 30, 0)), prior)


def posterior(record, k):
    """Mean and standard deviation of x after sample k, by quadrature over the initial state."""
    x0 = np.linspace(1e-4, 4, 200001)
    at_start = record.y[0, : k + 1, 0] + record.t[: k + 1]  # log x(t) = log x0 − t
    log_density = -0.5 * ((x0 - 1) / 0.4) ** 2
    log_density -= 0.5 * ((at_start[:, None] - np.log(x0)) ** 2).sum(axis=0) / NOISE**2
    p = np.exp(log_density - log_density.max())
    p /= p.sum()
    mean = (p * x0).sum()
    std = np.sqrt((p * (x0 - mean) ** 2).sum())
    return mean * np.exp(-record.t[k]), std * np.exp(-record.t[k])


def test_particles_without_an_output_have_no_weight(said):
    """A hundredth of the particles is below zero, where the logarithm is not defined."""
    record = log_record()
    found = ParticleFilter(LogSensor(), particles=4000).run(record)
    for k in (0, 3, 10, 29):
        mean, std = posterior(record, k)
        assert abs(found.xhat[0, k, 0] - mean) < 0.25 * std
        assert np.sqrt(found.P[0, k, 0, 0]) == pytest.approx(std, rel=0.15)
    assert np.isfinite(found.innovation).all()
    assert np.isfinite(found.S).all()
    assert said() == []


def test_where_no_particle_has_an_output_the_sample_is_left_out_and_it_is_said(said):
    record = log_record(batch=2)
    mean = np.array([[-3.0], [1.0]])
    away = Record(record.t, record.y, record.u, Prior(mean, np.full((2, 1, 1), 0.01)))
    found = ParticleFilter(LogSensor()).run(away)
    np.testing.assert_allclose(found.xhat[0, :, 0], -3 * np.exp(-record.t), rtol=0.02)
    assert (found.innovation[0] == 0).all()
    alone = ParticleFilter(LogSensor()).run(away.rows(slice(1, 2)))
    np.testing.assert_allclose(found.xhat[1], alone.xhat[0], rtol=1e-10)
    assert said() == [
        "particle filter on LogSensor: an output is not defined, or impossible, at all particles; "
        "it is left out"
    ]


def test_particles_that_overflow_are_left_behind(said):
    """At ẋ = 20x³ only |x| < 1/√(40 t) is still there at t; x = 0 stays."""
    system = Explosive()
    t = np.arange(30) * 0.1
    y = NOISE * np.random.default_rng(1).standard_normal((1, 30, 1))
    prior = Prior.of(system, system.setups["benchmark"], 1)
    found = ParticleFilter(system).run(Record(t, y, np.zeros((1, 30, 0)), prior))
    assert np.isfinite(found.xhat).all()
    assert np.isfinite(found.P).all()
    assert (abs(found.xhat[0, 1:, 0]) < 1 / np.sqrt(40 * t[1:]) + 0.05).all()
    assert said() == []


def test_where_all_particles_overflow_it_is_said(said):
    system = Explosive()
    t = np.arange(5) * 0.1
    prior = Prior(np.array([[1e60]]), np.ones((1, 1, 1)))
    missing = np.full((1, 5, 1), np.nan)
    found = ParticleFilter(system).run(Record(t, missing, np.zeros((1, 5, 0)), prior))
    np.testing.assert_allclose(found.xhat, 1e60)
    assert said() == [
        "particle filter on Explosive: all particles overflow in the model; "
        "they stay where they are"
    ]
