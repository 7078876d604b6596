"""Gaussians of angles that are wider than their circle."""

import logging

import numpy as np
import pytest
from angles import Compass
from circle import NOISE, Direction, Pair, Turns, circle_record, on_grid

from pinnobs_gym.estimation.estimator import State
from pinnobs_gym.estimation.square_root import covariance
from pinnobs_gym.estimation.wrapping import wrapped_moments, wrapped_state
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.simulation.notices import say_once

GAUSSIAN = ("ekf", "strong_tracking_ekf", "ukf", "ckf", "enkf", "mhe", "rts_smoother")


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


@pytest.mark.parametrize("period", [360.0, 1.0])
@pytest.mark.parametrize("share", [0.05, 0.0834, 0.12, 0.3, 2.0])
def test_moments_are_those_of_wrapped_normal_numbers(share, period):
    std = share * period
    z = std * np.linspace(-9, 9, 2_000_001)
    p = np.exp(-np.square(z / std) / 2)
    p /= p.sum()
    wrapped = z - period * np.round(z / period)
    g, f = wrapped_moments(np.array([std**2]), period)
    np.testing.assert_allclose(g, (p * wrapped * z).sum() / std**2, atol=1e-5)
    np.testing.assert_allclose(f, (p * wrapped**2).sum(), rtol=1e-6)


def test_correlations_go_with_the_turns_that_do_not_count():
    """Moments of draws of a heading and a rate, the heading within half a turn of its mean."""
    rng, system = np.random.default_rng(0), Compass()
    P = np.array([[2.25, 0.9], [0.9, 0.49]])
    draws = rng.multivariate_normal(np.zeros(2), P, size=400_000)
    draws[:, 0] = np.angle(np.exp(1j * draws[:, 0]))
    root = np.linalg.cholesky(P)
    state = State(
        np.zeros((2, 2)), P=np.stack([P, P]), root=np.stack([root, np.full((2, 2), np.nan)])
    )
    found = wrapped_state(system, state)
    assert found.P is not None
    assert found.root is not None
    np.testing.assert_allclose(found.P[1], np.cov(draws.T), atol=0.01)
    np.testing.assert_allclose(found.P[0], found.P[1], atol=1e-12)
    np.testing.assert_allclose(covariance(found.root[:1]), found.P[:1], atol=1e-12)
    assert np.isnan(found.root[1]).all()


def test_narrow_covariances_are_unchanged():
    state = State(np.zeros((1, 2)), P=np.diag([0.25, 100.0])[None])
    assert wrapped_state(Compass(), state) is state


@pytest.mark.parametrize(
    "std", [0.2, 1.6, 10.0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1.0, 2.5, 5.0))]
)
@pytest.mark.parametrize("name", GAUSSIAN)
def test_a_direction_that_is_measured_is_found_from_any_prior(name, std, said):
    """Against the exact filter on the circle."""
    system = Direction()
    x, record = circle_record(system, std)
    mean, variance = on_grid(system, std, record)
    run = ESTIMATORS.resolve(name)(system, assumed_noise=0.0).run(record)
    assert run.P is not None
    error = system.state_residual(run.xhat, x)[..., 0]
    nees = error**2 / run.P[..., 0, 0]
    assert (nees.mean(axis=0) < 1.4).all()
    if name not in ("rts_smoother", "enkf"):
        off = system.state_residual(run.xhat, mean[..., None])[..., 0] / np.sqrt(variance)
        assert np.quantile(abs(off), 0.99) < 0.1
    assert not said()


@pytest.mark.parametrize("name", ["ukf", "ckf"])
def test_points_follow_an_output_around_the_circle(name):
    """Points that lie beyond half a turn: an output that is linear in the state has the gain of the
    Kalman filter."""
    system, variance = Turns(), 2.5**2
    _, record = circle_record(system, 2.5, samples=1)
    run = ESTIMATORS.resolve(name)(system, assumed_noise=0.0).run(record)
    gain = variance / (variance + NOISE**2)
    innovation = system.output_residual(record.y[:, 0], 0 * record.y[:, 0])
    np.testing.assert_allclose(run.xhat[:, 0], gain * innovation, atol=1e-9)
    np.testing.assert_allclose(run.P[:, 0, 0, 0], gain * NOISE**2, rtol=1e-9)


@pytest.mark.parametrize("name", GAUSSIAN)
@pytest.mark.parametrize(
    ("system", "expected"), [(Turns(), "output y repeats"), (Pair(), "state angle repeats")]
)
def test_it_is_said_once_where_covariances_may_be_too_small(system, expected, name, said):
    for std in (0.3, 1.6, 3.0):
        _, record = circle_record(system, std, runs=20)
        ESTIMATORS.resolve(name)(system, assumed_noise=0.0).run(record)
        if std < 1:
            assert not said()
    (line,) = said()
    assert line.startswith(f"{name} on {type(system).__name__}: {expected}")


def test_a_batch_fit_says_it_too(said):
    _, record = circle_record(Pair(), 3.0, runs=3)
    ESTIMATORS.resolve("batch_least_squares")(Pair(), process_noise=0.0).run(record)
    assert len(said()) == 1
