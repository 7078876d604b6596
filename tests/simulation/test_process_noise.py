"""Process noise has one law, in truth, filters and ensembles, whatever the samples."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import expm

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.high_gain import HighGain
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.estimators.strong_tracking_ekf import StrongTrackingEKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.model import model_step_moments, noisy_model_step
from pinnobs_gym.simulation.noise import AssumedNoise, Noise, SampledLevel
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack


@dataclass(frozen=True)
class Free(System):
    """A mass that nothing but noise moves."""

    state_names = ("position", "velocity")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            x0_low=(-1.0, -1.0), x0_high=(1.0, 1.0), duration=10.0, dt=0.2, noise_std=0.1
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0)

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0.0, 1.0], [0.0, 0.0]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 0.0]])


A = np.array([[0.0, 1.0], [-4.0, -0.4]])


@dataclass(frozen=True)
class Swing(Free):
    """A damped oscillator whose noise acts on both states."""

    setups = {
        "benchmark": Setup(
            x0_low=(-1.0, -1.0),
            x0_high=(1.0, 1.0),
            xhat0=(0.0, 0.0),
            P0=independent(0.5, 0.5),
            duration=2.0,
            dt=0.25,
            noise_std=0.1,
            process_noise=((0.3, 0.0), (0.1, 0.5)),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -4.0 * x[..., 0] - 0.4 * x[..., 1])

    def f_jacobian(self, t, x, u):
        return matrix(x, A.tolist())


@dataclass(frozen=True)
class Pair(Free):
    """The mass with two sensors."""

    output_names = ("y1", "y2")

    def h(self, t, x, u):
        return stack(x, x[..., 0], x[..., 0] + x[..., 1])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 0.0], [1.0, 1.0]])

    setups = {"benchmark": replace(Free.setups["benchmark"], noise_std=(0.1, 0.2))}


def van_loan(A, L, dt):
    """The covariance of linear noise over a time (Van Loan 1978), and the matrix exponential."""
    n = len(A)
    M = expm(np.block([[-A, L @ L.T], [np.zeros((n, n)), A.T]]) * dt)
    F = M[n:, n:].T
    return F @ M[:n, n:], F


def test_the_covariance_over_a_step_is_the_closed_form():
    """dx = v dt, dv = q dw: Simpson's rule is exact for the cubic integrand."""
    q, dt = 0.7, 3.0
    noise = Free().noise(0.1, (0.0, q))
    x, F, Q = model_step_moments(Free(), noise, 1.0, 1.0 + dt, np.array([[0.5, 2.0]]))
    np.testing.assert_allclose(x, [[0.5 + 2 * dt, 2.0]])
    np.testing.assert_allclose(F[..., 0], [[1.0, dt], [0.0, 1.0]])
    expected = q**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    np.testing.assert_allclose(Q[..., 0], expected, rtol=1e-13)


@pytest.mark.parametrize("dt", [0.05, 1.0, 5.0])
def test_on_a_linear_plant_it_is_van_loans(dt):
    system, L = Swing(), np.array([[0.3, 0.0], [0.1, 0.5]])
    _, F, Q = model_step_moments(system, system.noise(), 0.0, dt, np.zeros((1, 2)))
    expected, flow = van_loan(A, L, dt)
    np.testing.assert_allclose(F[..., 0], flow, atol=1e-5)
    # The local error of a step is 1e-6 of scale at most.
    np.testing.assert_allclose(Q[..., 0], expected, atol=3e-6 * abs(expected).max() * max(1, dt))


def test_every_row_with_its_own_times_has_its_own():
    system = Swing()
    t0, t1 = np.array([0.0, 1.0, 2.0]), np.array([0.2, 1.1, 2.4])
    _, F, Q = model_step_moments(system, system.noise(), t0, t1, np.zeros((3, 2)))
    for i, dt in enumerate(t1 - t0):
        expected, flow = van_loan(A, np.array([[0.3, 0.0], [0.1, 0.5]]), dt)
        np.testing.assert_allclose(Q[..., i], expected, atol=1e-6)
        np.testing.assert_allclose(F[..., i], flow, atol=1e-5)


def line(blank: int) -> Record:
    """A line with noise, sampled every .2 s, with ``blank`` rows without outputs between two
    samples."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 10.0, 50 * (blank + 1) + 1)
    y = np.full(len(t), np.nan)
    y[:: blank + 1] = 0.3 * t[:: blank + 1] + 0.1 * rng.standard_normal(51)
    prior = Prior(np.zeros((1, 2)), np.eye(2)[None])
    return Record(t, y[None, :, None], np.zeros((1, len(t), 0)), prior)


@pytest.mark.parametrize(
    "kind", [EKF, UKF, CKF, StrongTrackingEKF, HighGain, RTSSmoother, MHE], ids=lambda k: k.name
)
def test_rows_without_outputs_change_nothing(kind):
    options = {"assumed_noise": 0.05}
    if kind is MHE:  # its window counts samples
        options["window"] = 1
    if kind is HighGain:
        options["theta"] = 0.0
    few, many = (kind(Free(), 0.1, (0.0, 0.05), **options).run(line(blank)) for blank in (0, 99))
    np.testing.assert_allclose(many.xhat[:, ::100], few.xhat, rtol=0, atol=1e-9)
    np.testing.assert_allclose(many.P[:, ::100], few.P, rtol=1e-8, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [EnKF, ParticleFilter], ids=lambda k: k.name)
def test_nor_those_of_an_ensemble_on_average(kind):
    """Mean and spread over 20 seeds, within a tenth of the standard deviation."""
    found = [
        [kind(Free(), 0.1, (0.0, 0.05), seed=seed).run(line(blank)) for seed in range(20)]
        for blank in (0, 4)
    ]
    mean = [np.mean([run.xhat[0, -1] for run in runs], axis=0) for runs in found]
    std = [np.sqrt(np.mean([run.P[0, -1] for run in runs], axis=0).diagonal()) for runs in found]
    kalman = EKF(Free(), 0.1, (0.0, 0.05), assumed_noise=0.0).run(line(0))
    own = np.sqrt(kalman.P[0, -1].diagonal())
    assert (abs(mean[0] - mean[1]) < 0.15 * own).all()
    assert (abs(std[0] - std[1]) < 0.1 * own).all()
    assert (abs(mean[0] - kalman.xhat[0, -1]) < 0.15 * own).all()


def test_ensembles_have_the_covariance_of_the_law():
    system, count, dt = Swing(), 200_000, 0.5
    rng = np.random.default_rng(1)
    x = noisy_model_step(
        system,
        system.noise(),
        0.0,
        dt,
        np.zeros((count, 1, 2)),
        None,
        None,
        lambda size: rng.standard_normal((count, 1, size)),
    )[:, 0]
    expected, _ = van_loan(A, np.array([[0.3, 0.0], [0.1, 0.5]]), dt)
    error = np.sqrt(2.0 / count) * expected.diagonal().max()  # of a sample variance
    np.testing.assert_allclose(x.T @ x / count, expected, atol=4 * error)


@dataclass(frozen=True)
class FromRest(Swing):
    """The oscillator from rest."""

    setups = {
        "benchmark": replace(Swing.setups["benchmark"], x0_low=(0.0, 0.0), x0_high=(0.0, 0.0))
    }


def test_truth_has_it_too():
    source = EpisodeSource(FromRest)
    episodes = source.play(source.draw(source.streams(range(4000))))
    for k in (1, 8):
        expected, _ = van_loan(A, np.array([[0.3, 0.0], [0.1, 0.5]]), k * 0.25)
        x = episodes.x[k]
        error = np.sqrt(2.0 / len(x)) * expected.diagonal().max()
        np.testing.assert_allclose(x.T @ x / len(x), expected, atol=4 * error)
    # An episode does not depend on its batch.
    alone = source.play(source.draw(source.streams([7])))
    np.testing.assert_array_equal(alone.x[:, 0], episodes.x[:, 7])


def test_a_filter_of_it_is_consistent():
    """The squared errors over their variances average one, for the plant's own law."""
    source = EpisodeSource(Swing)
    episodes = source.play(source.draw(source.streams(range(300))))
    record = source.record(episodes)
    found = EKF.for_setup(source.system, source.setup, assumed_noise=0.0).run(record)
    error = found.xhat - episodes.x[:-1].swapaxes(0, 1)
    last = error[:, -1]
    nees = np.einsum("bi,bij,bj->b", last, np.linalg.inv(found.P[:, -1]), last)
    assert abs(nees.mean() - 2) < 4 * np.sqrt(2 * 2 / 300)


def kalman(record, Q, R):
    """The Kalman filter of `Pair`, which leaves out what is missing."""
    F, H = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[1.0, 0.0], [1.0, 1.0]])
    x, P = record.prior.mean[0], record.prior.cov[0]
    means, covs = [], []
    for k, y in enumerate(record.y[0]):
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        seen = ~np.isnan(y)
        C, S = H[seen], H[seen] @ P @ H[seen].T + R(k)[np.ix_(seen, seen)]
        K = P @ C.T @ np.linalg.inv(S)
        x, P = x + K @ (y[seen] - C @ x), P - K @ C @ P
        means.append(x)
        covs.append(P)
    return np.array(means), np.array(covs)


def pair_record() -> Record:
    rng = np.random.default_rng(3)
    t = np.arange(30) * 0.2
    y = np.stack([0.3 * t, 0.3 * t + 0.3], axis=1) + rng.standard_normal((30, 2)) @ G.T
    y[rng.random(y.shape) < 0.3] = np.nan
    prior = Prior(np.zeros((1, 2)), np.eye(2)[None])
    return Record(t, y[None], np.zeros((1, 30, 0)), prior)


G = np.array([[0.1, 0.0], [0.15, 0.05]])
Q_PAIR = 0.05**2 * np.array([[0.2**3 / 3, 0.2**2 / 2], [0.2**2 / 2, 0.2]])


@pytest.mark.parametrize("kind", [EKF, UKF, CKF, RTSSmoother], ids=lambda k: k.name)
def test_correlated_outputs_of_which_some_are_missing(kind):
    record = pair_record()
    own = kind(Pair(), G.tolist(), (0.0, 0.05), assumed_noise=0.0).run(record)
    means, covs = kalman(record, Q_PAIR, lambda k: G @ G.T)
    last = -1 if kind is RTSSmoother else slice(None)  # a smoother agrees at the end
    np.testing.assert_allclose(own.xhat[0, last], means[last], atol=1e-10)
    np.testing.assert_allclose(own.P[0, last], covs[last], atol=1e-11)


@pytest.mark.parametrize("kind", [EnKF, ParticleFilter], ids=lambda k: k.name)
def test_correlated_outputs_of_an_ensemble(kind):
    record = pair_record()
    options = {"particles": 4000}
    if kind is EnKF:
        options = {"members": 4000, "inflation": 1.0, "assumed_noise": 0.0}
    own = kind(Pair(), G.tolist(), (0.0, 0.05), **options).run(record)
    means, covs = kalman(record, Q_PAIR, lambda k: G @ G.T)
    off = abs(own.xhat[0] - means) / np.sqrt(np.einsum("kii->ki", covs))
    assert np.sqrt(np.mean(off**2)) < 0.1
    assert off.max() < 0.5


def test_noise_that_differs_by_sample():
    record = pair_record()
    std = np.random.default_rng(4).uniform(0.05, 0.5, (1, 30, 2))
    std[0, 5, 1] = np.nan  # as told for the others
    level = SampledLevel(record.t, std)
    own = EKF(Pair(), level, (0.0, 0.05), assumed_noise=0.0).run(record)
    told = np.where(np.isnan(std), (0.1, 0.2), std)
    means, _ = kalman(record, Q_PAIR, lambda k: np.diag(told[0, k] ** 2))
    np.testing.assert_allclose(own.xhat[0], means, atol=1e-10)


class Later(Noise):
    """Output noise that is ten times as large from the sample at 3 s on."""

    def G(self, t):
        return super().G(t) * (10.0 if t >= 2.9 else 1.0)


@dataclass(frozen=True)
class Ageing(Pair):
    def noise(self, noise_std=None, process_noise=None):
        known = super().noise(noise_std, process_noise)
        return Later(known.process, known.output, known.samples)


def test_a_system_may_say_its_noise_itself():
    record = pair_record()
    own = EKF(Ageing(), G.tolist(), (0.0, 0.05), assumed_noise=0.0).run(record)
    R = G @ G.T
    means, _ = kalman(record, Q_PAIR, lambda k: R * (100.0 if record.t[k] >= 2.9 else 1.0))
    np.testing.assert_allclose(own.xhat[0], means, atol=1e-10)


def test_what_is_assumed_beyond_is_a_share_of_scale_per_duration():
    system = Swing()
    assumed = AssumedNoise.of(system, system.noise(), 0.02)
    L = assumed.L(0.0)[..., 0]
    own = np.array([[0.3, 0.0], [0.1, 0.5]])
    np.testing.assert_allclose(L @ L.T, own @ own.T + np.eye(2) * 0.02**2 / 2.0)
    assert AssumedNoise.of(system, system.noise(0.1, 0.0)).L(0.0).shape == (2, 0, 1)


@pytest.mark.parametrize(
    ("levels", "line"),
    [
        (((0.1, 0.2, 0.3), None), "noise_std of Pair has shape (3,); expected 2 number(s)"),
        ((-0.1, None), "noise_std=-0.1 of Pair; expected numbers of at least 0"),
        ((0.1, (0.1, np.nan)), "process_noise=(0.1, nan) of Pair"),
        (((((0.1,), (0.2,))), None), "noise_std of Pair has shape (2, 1); expected (2, 2)"),
        ((0.1, ((1.0, 0.0),)), "process_noise of Pair has shape (1, 2); expected 2 number(s)"),
        (("a", None), "noise_std='a' of Pair; expected numbers of at least 0"),
    ],
)
def test_wrong_levels_are_refused_in_one_line(levels, line):
    with pytest.raises(ValueError, match=re.escape(line)) as raised:
        EKF(Pair(), *levels)
    assert "\n" not in str(raised.value)
