"""The unscented and the cubature Kalman filter against filterpy's, and against closed forms."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from filterpy.kalman import CubatureKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas
from linear import NOISE_OF_FILTERS, Linear, kalman_filter, linear_record, record_of
from pendulum import NoisyPendulum, pendulum_record

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ckf import CKF
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.matrices import factor
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

BOTH = pytest.mark.parametrize("kind", [UKF, CKF])


@BOTH
@pytest.mark.parametrize(("process_noise", "noise_std", "atol"), NOISE_OF_FILTERS)
def test_on_a_linear_system_it_is_the_kalman_filter(kind, process_noise, noise_std, atol):
    record = linear_record()
    estimates = kind(Linear(), noise_std, process_noise, assumed_noise=0.0).run(record)
    for i in range(record.batch):
        for k, peer in enumerate(kalman_filter(record, i, process_noise, noise_std)):
            np.testing.assert_allclose(estimates.xhat[i, k], peer.x, atol=atol)
            np.testing.assert_allclose(estimates.P[i, k], peer.P, atol=atol)
            np.testing.assert_allclose(estimates.S[i, k], peer.S, atol=atol)
            np.testing.assert_allclose(estimates.innovation[i, k], peer.y, atol=atol)


def duffing_step(x, dt):
    return model_step(ReverseDuffing(), 0.0, dt, x)


def first_output(x):
    return x[:1]


class RedrawingCubatureFilter(CubatureKalmanFilter):
    """filterpy's filter takes the points of the prediction for the update, which do not know of Q;
    the paper draws new ones, as this does."""

    def predict(self, dt=None, fx_args=()):
        super().predict(dt, fx_args)
        self.sigmas_f = spherical_radial_sigmas(self.x, self.P)


def filterpy_ukf(beta):
    points = MerweScaledSigmaPoints(2, alpha=1.0, beta=beta, kappa=1.0)
    return UnscentedKalmanFilter(2, 1, 0.02, first_output, duffing_step, points)


def filterpy_ckf():
    return RedrawingCubatureFilter(2, 1, 0.02, first_output, duffing_step)


@pytest.mark.parametrize("assumed_noise", [0.0, 0.03])
@pytest.mark.parametrize(
    ("own", "peer"),
    [
        (UKF(ReverseDuffing()), lambda: filterpy_ukf(0.0)),
        (UKF(ReverseDuffing(), beta=2.0), lambda: filterpy_ukf(2.0)),
        (CKF(ReverseDuffing()), filterpy_ckf),
    ],
    ids=["ukf", "ukf, beta=2", "ckf"],
)
def test_it_agrees_with_filterpys_over_an_episode(own, peer, assumed_noise):
    """filterpy's filters are given the Q of each step about the own estimate."""
    record = record_of(EpisodeSource("ReverseDuffing"), 1)
    own, peer = replace(own, assumed_noise=assumed_noise), peer()
    estimates = own.run(record)
    mean, P0 = record.prior.mean[0], record.prior.cov[0]
    # The first sample is taken at t = 0: a prediction over no time comes before it there.
    peer.x, peer.P, peer.Q = mean.copy(), P0.copy(), np.zeros((2, 2))
    peer.R = np.array([[0.02**2]])
    for k in range(record.num_samples):
        if k:
            times = record.t[k - 1], record.t[k]
            before = estimates.xhat[:, k - 1]
            peer.Q = model_step_moments(own.system, own.noise, *times, before)[2][..., 0]
            assert peer.Q.any() == (assumed_noise > 0)
        peer.predict(0.02 if k else 0.0)
        peer.update(record.y[0, k])
        np.testing.assert_allclose(estimates.xhat[0, k], np.ravel(peer.x), atol=1e-9)


@dataclass(frozen=True)
class Walk(System):
    """x⁺ = [[1, 1], [0, 1]]x over one second, y = x₁/2 − 0.3x₂."""

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1, -1), (1, 1), duration=4.0, dt=1.0)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0)

    def h(self, t, x, u):
        return 0.5 * x[..., :1] - 0.3 * x[..., 1:]


@pytest.mark.parametrize("kind", [EKF, UKF, CKF])
def test_pykalmans_reference(kind):
    """The numbers of pykalman's own test of its unscented filter; the first output is missing."""
    prior = Prior(np.array([[1.0, 1.0]]), np.array([[[1.0, 0.1], [0.1, 1.0]]]))
    y = np.array([np.nan, 1.0, 2.0, 3.0])[None, :, None]
    record = Record(np.arange(4.0), y, np.zeros((1, 4, 0)), prior)
    # LLᵀ of a Q = 2I: over one second, Q = [[s₁₁ + s₁₂ + s₂₂/3, s₁₂ + s₂₂/2], [·, s₂₂]].
    L = np.linalg.cholesky([[7 / 3, -1.0], [-1.0, 2.0]])
    own = kind(Walk(), np.sqrt(0.5), L.tolist(), assumed_noise=0.0)
    expected = (6.71906243764755, 1.52810614201467)
    np.testing.assert_allclose(own.run(record).xhat[0, -1], expected, rtol=1e-9)


@pytest.mark.parametrize("kind", [EKF, UKF, CKF])
def test_sarkkas_pendulum(kind):
    """On single trajectories filters are known to reach a root mean squared error of the angle of
    about 0.13; here it is the median of 50."""
    x, record = pendulum_record(50)
    xhat = kind(NoisyPendulum(), assumed_noise=0.0).run(record).xhat
    rmse = np.sqrt(np.mean((xhat - x)[..., 0] ** 2, axis=1))
    assert np.median(rmse) == pytest.approx(0.13, abs=0.02)


@pytest.mark.parametrize("kind", [EKF, UKF, CKF])
@pytest.mark.parametrize("name", ["ReverseDuffing", "HarmonicOscillator"])
def test_covariances_stay_such_without_process_noise(kind, name):
    source = EpisodeSource(name, duration=10_000 * 0.02)
    record = record_of(source, 2)
    P = kind(source.system, assumed_noise=0.0).run(record).P
    size = abs(P).max(axis=(-2, -1))
    assert record.num_samples == 10_000
    assert (abs(P - P.swapaxes(-2, -1)).max(axis=(-2, -1)) <= 1e-15 * size).all()
    assert (np.linalg.eigvalsh(P)[..., 0] >= -1e-14 * size).all()


def test_jitter_is_added_where_it_is_needed_alone_and_reported():
    ones = np.ones((2, 2))
    P = np.stack([np.eye(2), 4 * ones, np.diag([1.0, -1.0]), np.zeros((2, 2))])
    L, jitter = factor(P.transpose(1, 2, 0), np.zeros(4))
    L = L.transpose(2, 0, 1)
    np.testing.assert_array_equal(L[0], np.eye(2))
    np.testing.assert_allclose(L[1] @ L[1].T, P[1], rtol=1e-9)
    assert np.isnan(L[2]).any()
    np.testing.assert_allclose(L[3], 0, atol=1e-100)
    assert jitter[0] == 0
    assert 0 < jitter[1] <= 1e-12


def test_a_state_known_exactly_stays_so():
    """P₀ may be singular; the state's memory says what was added to it."""
    record = linear_record(1)
    known = replace(record, prior=Prior(record.prior.mean, np.diag([0.0, 1.0])[None]))
    filter = UKF(Linear(), noise_std=0.1, assumed_noise=0.0)
    exact = EKF(Linear(), noise_std=0.1, assumed_noise=0.0).run(known)
    np.testing.assert_allclose(filter.run(known).xhat, exact.xhat, atol=1e-7)
    state = filter.update(filter.reset(known.prior), 0.0, known.y[:, 0], known.u[:, 0])
    assert 0 < state.memory.jitter[0] <= 1e-12


def test_weights_must_not_be_negative():
    with pytest.raises(ValueError, match=r"beta=-1.0; expected a number of at least 0"):
        UKF(ReverseDuffing(), beta=-1.0)
