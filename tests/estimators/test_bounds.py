"""Bounds of states: estimates within them, on a reactor whose filters otherwise settle outside."""

import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
from benchmarks.plants.reactor import NOISE, QuietReactor, Reactor, reactor_record
from kinds import FEW, untrained
from linear import Linear, linear_record
from scipy.optimize import least_squares

from pinnobs_gym.estimation.checks import ESTIMATOR_CHECKS, check_estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.augmented import augmented
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.simulation.system import matrix, stack

MODELS = ["ekf", "ukf", "ckf", "enkf", "particle", "strong_tracking_ekf", "mhe", "rts_smoother"]


@dataclass(frozen=True)
class Unbounded(Reactor):
    state_low = None


@dataclass(frozen=True)
class QuietUnbounded(QuietReactor):
    state_low = None


def plant_of(name, *kinds):
    """The first plant that an estimator takes."""
    noisy = "process_noise" in ESTIMATORS.resolve(name).takes
    return kinds[0] if noisy else kinds[1]


@dataclass(frozen=True)
class Exceeding(Reactor):
    """Its truth exceeds the upper bound."""

    state_high = (None, 1.5)
    setups = {"benchmark": replace(Reactor.setups["benchmark"], xhat0=(0.1, 1.4))}


@pytest.mark.parametrize("name", untrained())
def test_estimates_stay_within_the_bounds(name):
    system = plant_of(name, Reactor, QuietReactor)()
    estimator = ESTIMATORS.resolve(name)(system)
    ESTIMATOR_CHECKS["bounds"](estimator)
    _, record = reactor_record(system, 20)
    assert (estimator.run(record).xhat >= 0).all()


@pytest.mark.parametrize("name", ["ekf", "ukf", "enkf", "particle", "mhe", "batch_least_squares"])
@pytest.mark.parametrize("kind", [Reactor, QuietReactor])
def test_estimators_of_a_plant_with_bounds_conform(name, kind):
    options = {"window": 3} if name == "mhe" else FEW.get(name, {})
    check_estimator(ESTIMATORS.resolve(name)(plant_of(name, kind, QuietReactor)(), **options))


def test_moving_horizons_are_right_from_the_tenth_sample_on():
    """Of 20 runs, in 1820 samples, each pressure is within three standard deviations, which 99.7 %
    of Gaussian numbers are, and the typical error is a few per cent."""
    for kind, inside in ((Reactor, 1.0), (QuietReactor, 0.995)):
        x, record = reactor_record(kind(), 20)
        found = MHE(kind()).run(record)
        error = abs(found.xhat - x)[:, 9:]
        std = np.sqrt(np.einsum("bkii->bki", found.P))[:, 9:]
        assert np.mean(error <= 3 * std) >= inside
        assert np.median(error / x[:, 9:]) < 0.03
        assert np.mean(error / x[:, 9:] < 0.1) > 0.97
    x, record = reactor_record(Unbounded(), 20)
    error = abs(MHE(Unbounded()).run(record).xhat - x)[:, 9:]
    assert np.median(error / x[:, 9:]) > 1  # settles at negative pressures


def window_residuals(record, row, system, own, states):
    """The whitened terms of the window's cost at states (num_samples, 2) of a record, with the
    process noise linearised about the states ``own``, as the estimator has it."""
    prior, noise = record.prior, system.noise()
    terms = [(states[0] - prior.mean[row]) / np.sqrt(np.diag(prior.cov[row]))]
    for k, x in enumerate(states):
        terms.append((record.y[row, k] - x.sum()) / NOISE)
        if k + 1 < len(states):
            t = record.t[k], record.t[k + 1]
            _, _, Q = model_step_moments(system, noise, *t, own[k, None])
            defect = states[k + 1] - model_step(system, *t, x)
            terms.append(np.linalg.solve(np.linalg.cholesky(Q[..., 0]), defect))
    return np.concatenate(terms)


def test_moving_horizons_find_what_scipy_finds_within_bounds():
    """Ten samples are a window: the whole record so far, with all its states."""
    system = Reactor()
    _, record = reactor_record(system, 3)
    y = record.y.copy()
    y[1, :10] = 0.02 * np.random.default_rng(3).standard_normal((10, 1))
    record = replace(record, y=y)
    mhe = MHE(system, assumed_noise=0.0, steps=10)
    state = mhe.reset(record.prior)
    for k in range(10):
        state = mhe.update(state, float(record.t[k]), record.y[:, k], record.u[:, k])
    own = state.memory.whole.x
    for row in range(3):
        peer = least_squares(
            lambda z, row=row: window_residuals(record, row, system, own[:, row], z.reshape(10, 2)),
            np.maximum(own[:, row].ravel(), 1e-3) + 0.01,
            bounds=(0.0, np.inf),
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-12,
        )
        np.testing.assert_allclose(own[:, row].ravel(), peer.x, atol=1e-4)
    assert own[:, 1].min() == 0.0  # a bound is active


def test_least_squares_find_what_scipy_finds_within_bounds():
    system = QuietReactor()
    _, record = reactor_record(system, 3)
    y = record.y[:, :40].copy()
    y[0] -= 4.5  # no positive pressures explain it
    y[1] -= 0.3
    record = replace(record.first_samples(40), y=y)
    found = BatchLeastSquares(system).run(record).xhat[:, 0]
    std0 = np.sqrt(np.diag(record.prior.cov[0]))

    def residuals(x0, row):
        terms, x = [(x0 - record.prior.mean[row]) / std0], x0
        for k in range(40):
            if k:
                x = model_step(system, record.t[k - 1], record.t[k], x)
            terms.append((record.y[row, k] - x.sum()) / NOISE)
        return np.concatenate(terms)

    for row in range(3):
        start = np.maximum(found[row], 1e-3) + 0.01
        peer = least_squares(residuals, start, args=(row,), bounds=(0.0, np.inf), xtol=1e-14)
        np.testing.assert_allclose(found[row], peer.x, atol=1e-5)
    assert found[0].min() == 0.0


@pytest.mark.parametrize("name", [*MODELS, "batch_least_squares"])
def test_bounds_that_are_far_away_change_nothing(name):
    """Points of a wide spread would come near them."""
    x, record = reactor_record(Reactor(), 3)
    prior = Prior(x[:, 0] + 0.05, 0.01 * np.eye(2)[None].repeat(3, 0))
    near = replace(record, prior=prior)
    cls = ESTIMATORS.resolve(name)
    bounded, free = plant_of(name, (Reactor, Unbounded), (QuietReactor, QuietUnbounded))
    found, free = cls(bounded()).run(near), cls(free()).run(near)
    np.testing.assert_array_equal(found.xhat, free.xhat)
    np.testing.assert_array_equal(found.P, free.P)


@dataclass(frozen=True)
class BoundedLinear(Linear):
    """Its truth leaves these bounds."""

    state_low = (-0.2, None)
    state_high = (None, 0.3)
    setups = {
        "benchmark": replace(Linear.setups["benchmark"], x0_low=(-0.2, -1.0), x0_high=(1.0, 0.3))
    }


def test_the_nearest_point_is_that_of_all_filters_on_a_linear_system():
    """Sigma points outside of the bounds are extended to first order, which here is exact."""
    record = linear_record()
    record.y[1, 5:12] = np.nan  # a gap neither moves the points nor narrows them
    own = EKF(BoundedLinear(), noise_std=0.1).run(record)
    for cls in (UKF, CKF):
        found = cls(BoundedLinear(), noise_std=0.1).run(record)
        np.testing.assert_allclose(found.xhat, own.xhat, atol=1e-12)
        np.testing.assert_allclose(found.P, own.P, atol=1e-12)
    assert own.xhat[..., 0].min() == -0.2
    assert own.xhat[..., 1].max() == 0.3


def test_bounds_of_a_wrong_size_or_order_are_told_in_one_line():
    for low, high, line in (
        ((0.0,), None, r"system Wrong: state_low has 1 bounds; expected 2, None for no bound"),
        (None, (1.0, "x"), r"system Wrong: state_high=\(1.0, 'x'\); expected numbers, None for"),
        ((0.0, 2.0), (None, 2.0), r"state_low=2 of state 2 is not below state_high=2"),
        ((float("nan"), 2.0), None, r"state_low=\(nan, 2.0\); expected numbers"),
    ):

        @dataclass(frozen=True)
        class Wrong(Reactor):
            state_low = low
            state_high = high

        with pytest.raises(TypeError, match=line):
            Wrong.validate()


def test_a_truth_that_leaves_the_bounds_is_told_in_one_line():
    with pytest.raises(CheckFailed) as caught:
        check_system(Exceeding)
    assert str(caught.value).startswith(
        "bounds: in the truth of setup 'benchmark', pB comes to 2.3"
    )
    assert "above state_high=1.5; expected a plant that stays within its bounds" in str(
        caught.value
    )
    check_system(Reactor)


def test_an_estimator_that_leaves_the_bounds_fails_the_check(monkeypatch):
    @dataclass(frozen=True)
    class Outside(EKF):
        pass

    def run(self, record):  # set afterwards, it is not the method that keeps estimates inside
        return replace(EKF.run(self, record), xhat=-np.ones((3, record.num_samples, 2)))

    ESTIMATOR_CHECKS["bounds"](Outside(Reactor()))
    monkeypatch.setattr(Outside, "run", run)
    line = r"bounds: the estimate \[-1.0, -1.0\] at sample 0 of row 0 is outside of the bounds"
    with pytest.raises(CheckFailed, match=line):
        ESTIMATOR_CHECKS["bounds"](Outside(Reactor()))


@dataclass(frozen=True)
class Rated(Reactor):
    """The reactor with a parameter, its rate of reaction."""

    rate: float = 0.16

    def f(self, t, x, u):
        rate = self.rate * x[..., 0] ** 2 - 0.0064 * x[..., 1]
        return stack(x, -2 * rate, rate)

    def f_jacobian(self, t, x, u):
        by_a, by_b = 2 * self.rate * x[..., 0], -0.0064
        return matrix(x, [[-2 * by_a, -2 * by_b], [by_a, by_b]])


def test_unknown_constants_have_bounds_beside_those_of_the_plant():
    system = augmented(Rated(), {"rate": Unknown(0.16, 0.1, low=0.05)})
    assert system.state_low == (0.0, 0.0, 0.05)
    assert system.state_high is None
    setup = system.setups["benchmark"]
    assert setup.x0_low[2] == 0.05
    assert setup.x0_high[2] == pytest.approx(0.16 + np.sqrt(3) * 0.1)
    assert augmented(Unbounded(), output_bias={"p": Unknown(0.0, 1.0)}).state_low is None
    ESTIMATOR_CHECKS["bounds"](UKF(system))
    for bounds, line in (
        ({"low": 1.0}, "low=1.0 of an Unknown; expected a number below mean=0.1"),
        ({"high": 0.1}, "high=0.1 of an Unknown; expected a number above mean=0.1"),
    ):
        with pytest.raises(ValueError, match=line):
            Unknown(0.1, 0.1, **bounds)


@pytest.mark.parametrize("name", [*MODELS, "batch_least_squares"])
def test_a_row_is_the_same_alone_and_beside_rows_at_their_bounds(name):
    _, record = reactor_record(Reactor(), 7)
    estimator = ESTIMATORS.resolve(name)(plant_of(name, Reactor, QuietReactor)())
    together, alone = estimator.run(record), estimator.run(record.rows(slice(3, 4)))
    np.testing.assert_array_equal(together.xhat[3], alone.xhat[0])
    np.testing.assert_array_equal(together.P[3], alone.P[0])


SEEN = []
"""Smallest values of the states at which `Watched` was asked for an output."""


@dataclass(frozen=True)
class Watched(Reactor):
    def h(self, t, x, u):
        SEEN.append(float(np.min(x)))
        return super().h(t, x, u)


@pytest.mark.parametrize("name", ["ukf", "ckf", "enkf"])
def test_sigma_points_and_members_stay_within_the_bounds(name):
    _, record = reactor_record(Reactor(), 5)
    estimator = ESTIMATORS.resolve(name)(Watched())
    estimator.noise  # noqa: B018 (what is asked once of h is not asked by the filter)
    SEEN.clear()
    found = estimator.run(record)
    assert min(SEEN) >= 0.0
    assert found.xhat.min() >= 0.0
    assert len(SEEN) >= record.num_samples


def test_where_all_particles_are_outside_it_is_said_and_the_estimate_is_inside(caplog):
    say_once.cache_clear()
    caplog.set_level(logging.WARNING, "pinnobs_gym.simulation.notices")
    _, record = reactor_record(Reactor(), 2)
    mean = np.array([[-8.0, -8.0], [3.0, 1.0]])
    away = replace(record, prior=Prior(mean, 0.01 * np.eye(2)[None].repeat(2, 0))).first_samples(5)
    found = ParticleFilter(Reactor()).run(away)
    assert (found.xhat >= 0).all()
    assert [each.getMessage() for each in caplog.records] == [
        "particle filter on Reactor: all particles are outside of the bounds; they stay where they "
        "are"
    ]
    alone = ParticleFilter(Reactor()).run(away.rows(slice(1, 2)))
    np.testing.assert_allclose(found.xhat[1], alone.xhat[0], rtol=1e-10)
    say_once.cache_clear()
