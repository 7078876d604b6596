"""Ensembles, particles, strong tracking and constant-gain observers."""

import sys
from dataclasses import dataclass, replace

import numpy as np
import pytest
from linear import A, H, Linear, linear_record, process_covariance, record_of, runge_kutta_matrix

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.observer_gains import (
    default_rate,
    design_states,
    injection,
    lmi_gain,
    operating_points,
    placed_gain,
    placed_gains,
    settling_gain,
)
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.high_gain import HighGain
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.sliding_mode import SlidingMode
from pinnobs_gym.estimators.strong_tracking_ekf import StrongTrackingEKF
from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.scoring.exact_bayes import exact_bayes
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, output_scale, stack
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems import SYSTEMS


def test_strong_tracking_is_the_kalman_filter_of_its_own_process_noise():
    record = linear_record(1)
    own = StrongTrackingEKF(Linear(), noise_std=(0.1, 0.2), gamma=1e-3, output_factor=0.5)
    found = own.run(record)
    x, P, F = record.prior.mean[0], record.prior.cov[0], runge_kutta_matrix(0.1)
    R, e = np.diag([0.01, 0.04]), np.zeros(2)
    Q = process_covariance(3e-3 / np.sqrt(2.0))  # assumed_noise over the benchmark's 2 s
    for k in range(record.num_samples):
        if k:
            q = 1e-3 * (e @ np.linalg.solve(R, e)) / 2
            x, P = F @ x, F @ P @ F.T + Q + q * np.eye(2)
        e, S = record.y[0, k] - H @ x, H @ P @ H.T * 1.5 + R
        K = P @ H.T @ np.linalg.inv(S)
        x, P = (
            x + K @ e,
            (np.eye(2) - K @ H) @ P @ (np.eye(2) - K @ H).T + K @ (R + 0.5 * H @ P @ H.T) @ K.T,
        )
        np.testing.assert_allclose(found.xhat[0, k], x, atol=1e-10)
        np.testing.assert_allclose(found.P[0, k], P, atol=1e-10)


def test_a_large_ensemble_is_the_kalman_filter_on_a_linear_system():
    record = linear_record()
    options = {"noise_std": (0.1, 0.2), "process_noise": 0.15}
    own = EnKF(Linear(), members=20_000, inflation=1.0, **options).run(record)
    exact = EKF(Linear(), **options).run(record)
    std = np.sqrt(np.einsum("bkii->bki", exact.P))
    assert (abs(own.xhat - exact.xhat) < 0.05 * std).all()
    assert (abs(np.einsum("bkii->bki", own.P) / std**2 - 1) < 0.05).all()


def test_inflation_enlarges_covariances():
    record = linear_record(1)
    tight = EnKF(Linear(), inflation=1.0).run(record).P
    loose = EnKF(Linear(), inflation=1.1).run(record).P
    assert (np.linalg.det(loose[0, 10:]) > np.linalg.det(tight[0, 10:])).all()


def test_many_particles_are_the_kalman_filter_on_a_linear_system():
    record = linear_record()
    own = ParticleFilter(Linear(), noise_std=0.1, particles=20_000, discount=0.995).run(record)
    exact = EKF(Linear(), noise_std=0.1, assumed_noise=0.0).run(record)
    std = np.sqrt(np.einsum("bkii->bki", exact.P))
    assert (abs(own.xhat - exact.xhat) < 0.4 * std).all()
    ratio = np.einsum("bkii->bki", own.P) / std**2
    assert ((ratio > 0.6) & (ratio < 1.6)).all()


@dataclass(frozen=True)
class Apart(Linear):
    """The second state neither is measured nor acts on the first."""

    output_names = ("y1",)

    def f(self, t, x, u):
        return stack(x, -x[..., 0], -2 * x[..., 1])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Cubed(System):
    """x at rest, its cube measured: a posterior that is not Gaussian."""

    state_names = ("x1",)
    output_names = ("y1",)
    scale = (1.0,)
    setups = {"benchmark": Setup((-1.0,), (1.0,), duration=0.4, dt=0.1, noise_std=0.3)}

    def f(self, t, x, u):
        return stack(x, 0.0)

    def h(self, t, x, u):
        return x**3


def test_particles_find_a_posterior_that_is_not_gaussian():
    record = Record(
        np.arange(3) * 0.1,
        np.array([[[0.4], [np.nan], [0.1]]]),
        np.zeros((1, 3, 0)),
        Prior(np.zeros((1, 1)), np.full((1, 1, 1), 0.36)),
    )
    own = ParticleFilter(Cubed(), particles=50_000, discount=0.999).run(record)
    x = np.linspace(-4, 4, 20_001)
    log_density = -(x**2) / 0.72 - (0.4 - x**3) ** 2 / 0.18
    for k, y in enumerate((None, None, 0.1)):
        if y is not None:
            log_density = log_density - (y - x**3) ** 2 / 0.18
        density = np.exp(log_density - log_density.max())
        density /= density.sum()
        mean = (density * x).sum()
        assert own.xhat[0, k, 0] == pytest.approx(mean, abs=0.02)
        assert own.P[0, k, 0, 0] == pytest.approx((density * (x - mean) ** 2).sum(), rel=0.05)


def test_exact_bayes_of_the_same():
    source = EpisodeSource(Cubed)
    record = source.record(source.play(source.draw(source.streams([0]))))
    posterior = exact_bayes(EpisodeLaw.of(source), record).filtered
    x = np.linspace(-1, 1, 20_001)
    misfit = np.cumsum((record.y[0] - x**3) ** 2, axis=0)
    density = np.exp(-misfit / (2 * 0.3**2))
    mean = (density * x).sum(axis=1) / density.sum(axis=1)
    np.testing.assert_allclose(posterior.mean[0, :, 0], mean, atol=0.05)


@pytest.mark.parametrize("kind", [EnKF, ParticleFilter])
def test_random_numbers_are_those_of_the_seed(kind):
    record = linear_record(2)
    runs = [kind(Linear(), seed=seed).run(record).xhat for seed in (0, 0, 1)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert abs(runs[0] - runs[2]).max() > 1e-6


def test_high_gain_is_the_kalman_filter_of_weighted_outputs():
    """Without process noise: each output counts exp(−θ·age), the prior too."""
    record = linear_record(1)
    found = HighGain(Linear(), noise_std=0.1, theta=1.5).run(record)
    F, Phi = runge_kutta_matrix(0.1), np.eye(2)
    information, right = np.linalg.inv(record.prior.cov[0]), np.zeros(2)
    right = information @ record.prior.mean[0]
    for k in range(record.num_samples):
        if k:
            Phi = F @ Phi
            information, right = information * np.exp(-0.15), right * np.exp(-0.15)
        G = H @ Phi
        information = information + G.T @ G / 0.01
        right = right + G.T @ record.y[0, k] / 0.01
        np.testing.assert_allclose(
            found.xhat[0, k], Phi @ np.linalg.solve(information, right), atol=1e-10
        )
        expected = Phi @ np.linalg.inv(information) @ Phi.T
        np.testing.assert_allclose(found.P[0, k], expected, atol=1e-10)


def test_high_gain_forgets_no_more_than_there_was():
    record = linear_record(1)
    y = np.full(record.y.shape, np.nan)
    P = HighGain(Linear(), theta=20.0).run(Record(record.t, y, record.u, record.prior)).P
    assert np.trace(P[0], axis1=1, axis2=2).max() < 2 * (np.trace(record.prior.cov[0]) + 2)


def poles(system, gains):
    """Poles (num_gains, num_points, nx) of each of the gains at each of the operating points."""
    t, x = operating_points(system)
    u = system.input(np.asarray(t))
    A, C = system.f_jacobian(np.asarray(t), x, u), system.h_jacobian(t, x, u)
    return np.linalg.eigvals(A - gains[:, None] @ C)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_gains_place_poles_to_the_left_of_the_rate(name):
    system = SYSTEMS.resolve(name)()
    rate = default_rate(system)
    gains, _, _ = placed_gains(system, rate)
    assert len(gains) == 16
    at_own_point = np.einsum("iij->ij", poles(system, gains))
    assert at_own_point.real.max() <= -0.999 * rate


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_the_gain_that_is_taken_is_the_best_in_the_worst_case(name):
    system = SYSTEMS.resolve(name)()
    gains, _, _ = placed_gains(system, default_rate(system))
    slowest = poles(system, gains).real.max(axis=(1, 2))
    own = placed_gain(system, default_rate(system))
    assert poles(system, own[None]).real.max() == pytest.approx(slowest.min(), rel=1e-6)


def test_poles_that_are_asked_for_are_placed():
    system = SYSTEMS.resolve("ReverseDuffing")()
    gains, _, _ = placed_gains(system, 1.0, (-2.0, -3.0))
    found = np.einsum("iij->ij", poles(system, gains)).real
    np.testing.assert_allclose(np.sort(found), [[-3, -2]] * 16, rtol=1e-6)
    assert (placed_gain(system, 1.0, (-2.0, -3.0)) == gains).all(axis=(1, 2)).any()
    with pytest.raises(ValueError, match=r"poles=\(-1.0,\); ReverseDuffing has nx=2"):
        placed_gain(system, 1.0, (-1.0,))


def test_a_state_that_leaves_no_trace_is_said_to_have_none():
    with pytest.raises(ValueError, match="is not observable, so its poles cannot be placed"):
        placed_gain(Apart(), 1.0)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_designs_do_not_depend_on_the_prior(name):
    """Nor do they meet the prior's mean, which may be an equilibrium without observability."""
    cls = SYSTEMS.resolve(name)
    benchmark = cls.setups["benchmark"]
    elsewhere = replace(benchmark, xhat0=(7.0,) * cls().nx, P0=independent(*[0.0] * cls().nx))

    @dataclass(frozen=True)
    class Elsewhere(cls):
        setups = {"benchmark": elsewhere}

    rate = default_rate(cls())
    for design in (placed_gain, settling_gain):
        # To rounding: only one of the two may have its model's steps compiled.
        np.testing.assert_allclose(design(Elsewhere(), rate), design(cls(), rate), rtol=1e-9)
    np.testing.assert_array_equal(output_scale(Elsewhere()), output_scale(cls()))


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_gains_are_designed_for_admissible_states(name):
    x = design_states(SYSTEMS.resolve(name)())
    assert len(x) == 16
    assert EpisodeSource(name).contains(x).all()


def test_luenbergers_error_decays_as_its_poles_say():
    """On a linear system with fine samples, against the matrix exponential."""
    L = np.array([[2.0, 0.1], [-1.0, 1.5]])
    t = np.arange(0, 1.0001, 1e-3)
    x0 = np.array([[1.0, -0.5]])
    u, x = np.zeros((1, len(t), 0)), truth(Linear(), x0, t).swapaxes(0, 1)
    prior = Prior(np.zeros((1, 2)), np.eye(2)[None])
    record = Record(t, Linear().h(t, x, u), u, prior)
    xhat = Luenberger(Linear(), gain=L).run(record).xhat[0]
    values, vectors = np.linalg.eig(A - L @ H)
    flow = (vectors * np.exp(values)) @ np.linalg.inv(vectors)
    x_end = truth(Linear(), x0, t)[-1, 0]
    np.testing.assert_allclose(x_end - xhat[-1], (flow @ x0[0]).real, atol=2e-3)


def test_a_known_gain_of_reverse_duffing_settles():
    """L = (3, 3) is known to settle within a few seconds from everywhere in the set."""
    record = record_of(EpisodeSource("ReverseDuffing"), 20)
    system = SYSTEMS.resolve("ReverseDuffing")()
    own = Luenberger(system, gain=[[3.0], [3.0]]).run(record).xhat[:, -1]
    reference = EKF(system).run(record).xhat[:, -1]
    assert abs(own - reference).max() < 0.1


def test_large_gains_are_stable_and_missing_outputs_correct_nothing():
    H1 = np.array([[[1.0, 0.0]]] * 2)
    K = injection(np.array([[1e9], [1.0]]), H1, np.array([[0.1], [0.0]]))
    np.testing.assert_allclose(K[0, :, 0], [1.0, 1e-9], rtol=1e-6)
    assert (K[1] == 0).all()


def test_within_its_layer_sliding_mode_is_a_luenberger_observer_of_higher_gain():
    record = linear_record()
    own = SlidingMode(Linear(), noise_std=0.1, switching=4.0, layer=1e6)
    gain = 5.0 * settling_gain(Linear(), default_rate(Linear()), 5.0)
    peer = Luenberger(Linear(), gain=gain)
    np.testing.assert_allclose(own.run(record).xhat, peer.run(record).xhat, atol=1e-12)


def test_beyond_its_layer_sliding_mode_heeds_an_outlier_less():
    record = linear_record(1)
    y = record.y.copy()
    y[0, 10] += 100.0
    moved = []
    for kind in (
        SlidingMode(Linear(), noise_std=0.1, switching=4.0, layer=5.0),
        Luenberger(Linear(), gain=5.0 * settling_gain(Linear(), default_rate(Linear()), 5.0)),
    ):
        with_it = kind.run(Record(record.t, y, record.u, record.prior)).xhat[0, 10]
        moved.append(abs(with_it - kind.run(record).xhat[0, 10]).max())
    assert moved[0] < 0.75 * moved[1]


def test_an_lmi_finds_the_gain_of_a_linear_system():
    L = lmi_gain(Linear(), 1.0)
    assert np.linalg.eigvals(A - L @ H).real.max() < -0.99


@pytest.mark.parametrize("name", ["ReverseDuffing", "HarmonicOscillator", "Satellite"])
def test_an_lmi_without_a_solution_is_said_to_have_none(name):
    system = SYSTEMS.resolve(name)()
    with pytest.raises(ValueError, match=f"{name} has no constant gain and metric"):
        Luenberger(system, design="lmi").designed()


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (StrongTrackingEKF, {"gamma": -1.0}, "gamma=-1"),
        (EnKF, {"members": 1}, "members=1; expected from 2 to 1000000"),
        (EnKF, {"inflation": 0.9}, "inflation=0.9; expected"),
        (EnKF, {"members": 10**9}, "members=1000000000; expected from 2 to 1000000"),
        (ParticleFilter, {"particles": 1}, "particles=1; expected from 2 to 1000000"),
        (ParticleFilter, {"particles": 10**9}, "particles=1000000000; expected from 2 to 1000000"),
        (ParticleFilter, {"discount": 0.3}, "discount=0.3; expected"),
        (Luenberger, {"design": "magic"}, "design='magic'; expected 'poles' or 'lmi'"),
        (Luenberger, {"gain": [[1.0, 2.0]]}, "gain has shape"),
        (Luenberger, {"rate": 0.0}, "rate=0.0; expected a positive number"),
        (SlidingMode, {"layer": 0.0}, "layer=0.0; expected a positive number"),
        (HighGain, {"theta": -1.0}, "theta=-1.0; expected a number of at least 0"),
    ],
)
def test_settings_out_of_range_are_refused(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(Linear(), **options)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # of the solver
def test_a_rate_without_a_gain_is_named():
    observer = Luenberger(Linear(), rate=1e30)
    with pytest.raises(ValueError, match=r"^rate=1e\+30; Linear has no gain with such poles: "):
        observer.designed()


def test_without_cvxpy_the_lmi_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "cvxpy", None)
    with pytest.raises(ImportError, match=r"pip install \"pinnobs-gym\[lmi\]\""):
        lmi_gain(Linear(), 1.0)
