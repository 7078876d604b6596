"""Sigma points at which a model is not defined, or outside of bounds."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from array_api_compat import array_namespace

from pinnobs_gym.estimation.point_images import SigmaPoints
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.bounds import StateBox
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent

NOISE = 0.1
M = np.array([[1.0, 2.0], [-1.0, 0.5], [0.0, 3.0]])
LINE = "h is not defined"


@pytest.fixture
def said(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    yield lambda: [record.getMessage() for record in caplog.records]
    say_once.cache_clear()


def only_above(floor, seen):
    """A linear function that is NaN where the first component is below a floor."""

    def function(x):
        seen.append(x.copy())
        value = x @ M.T
        return np.where(x[..., :1] < floor, np.nan, value)

    return function


def points(batch=3):
    rng = np.random.default_rng(0)
    centre = np.abs(rng.standard_normal((batch, 2))) + 0.1
    return centre, rng.standard_normal((2, 5, batch))


def images(function, centre, deviations, bounds):
    sigma = SigmaPoints.of(centre, deviations, *(bounds or (None, None)))
    return sigma.images(function(sigma.used), function, jacobian, lambda: LINE)


def jacobian():
    return np.repeat(M[..., None], 3, axis=2)


def test_a_linear_function_has_the_values_of_the_original_points(said):
    """Whatever part of its domain is closed, and with bounds, too."""
    centre, deviations = points()
    original = (centre.T[:, None] + deviations).transpose(1, 2, 0)
    box = StateBox(np.zeros(2), np.full(2, np.inf)), np.tile(np.eye(2) + 0.3, (3, 1, 1))
    for floor, bounds in ((-np.inf, None), (0.0, None), (0.05, None), (-np.inf, box), (0.05, box)):
        seen = []
        found = images(only_above(floor, seen), centre, deviations, bounds)
        np.testing.assert_allclose(found, original @ M.T, atol=1e-12)
        if bounds is not None:
            assert min(x.min() for x in seen) >= 0.0
    assert said() == [LINE]


def test_a_row_that_needs_no_other_points_is_left_as_it_is():
    centre, deviations = points()
    deviations[:, :, 1] *= 0.01
    alone = images(only_above(0.0, []), centre, deviations, None)
    plain = (centre.T[:, None] + deviations).transpose(1, 2, 0) @ M.T
    np.testing.assert_array_equal(alone[:, 1], plain[:, 1])


def test_nothing_is_said_or_done_where_the_function_is_not_defined_at_the_estimate(said):
    centre, deviations = points()
    seen = []
    found = images(only_above(np.inf, seen), centre, deviations, None)
    assert np.isnan(found).all()
    assert len(seen) == 2
    assert said() == []


@dataclass(frozen=True)
class LogSensor(System):
    """A decay, of which the logarithm is measured."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {
        "benchmark": Setup(
            (0.5,),
            (1.5,),
            duration=3.0,
            dt=0.1,
            noise_std=NOISE,
            xhat0=(1.0,),
            P0=independent(1.2),
        )
    }

    def f(self, t, x, u):
        return -x

    def h(self, t, x, u):
        return array_namespace(x).log(x)

    def f_jacobian(self, t, x, u):
        return -np.ones((*x.shape, 1))

    def h_jacobian(self, t, x, u):
        return (1 / x)[..., None]


@pytest.mark.parametrize("cls", [UKF, CKF])
def test_filters_work_where_some_points_have_no_output(cls, said):
    """Against the Bayesian mean by quadrature over the initial state."""
    system, t = LogSensor(), np.arange(30) * 0.1
    rng = np.random.default_rng(0)
    y = (np.log(0.7) - t + NOISE * rng.standard_normal((2, 30)))[..., None]
    record = Record(t, y, np.zeros((2, 30, 0)), Prior.of(system, system.setups["benchmark"], 2))
    with np.errstate(invalid="ignore"):
        found = cls(system, assumed_noise=0.0).run(record)
    assert np.isfinite(found.xhat).all()
    assert np.isfinite(found.P).all()
    x0 = np.linspace(1e-4, 7, 100001)
    for row in range(2):
        at_start = y[row, :, 0] + t
        log_density = -0.5 * ((x0 - 1) / 1.2) ** 2
        log_density -= 0.5 * ((at_start[:, None] - np.log(x0)) ** 2).sum(axis=0) / NOISE**2
        p = np.exp(log_density - log_density.max())
        mean = (p * x0).sum() / p.sum() * np.exp(-t[-1])
        std = np.sqrt(found.P[row, -1, 0, 0])
        assert abs(found.xhat[row, -1, 0] - mean) < 2 * std
    assert said() == [
        f"{cls.name} on LogSensor: h is not defined at all sigma points; they are moved towards "
        "the estimate"
    ]


def test_where_points_stay_in_the_domain_nothing_changes(said):
    system, t = LogSensor(), np.arange(30) * 0.1
    y = (np.log(0.7) - t)[None, :, None]
    prior = Prior(np.array([[1.0]]), np.array([[[0.01]]]))
    record = Record(t, y, np.zeros((1, 30, 0)), prior)
    own, other = UKF(system).run(record), EKF(system).run(record)
    np.testing.assert_allclose(own.xhat, other.xhat, rtol=0.05)
    assert said() == []
