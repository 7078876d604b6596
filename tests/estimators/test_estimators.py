"""The filters against closed forms and other implementations."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from kinds import untrained
from linear import (
    NOISE_OF_FILTERS,
    H,
    Linear,
    kalman_filter,
    linear_record,
    process_covariance,
    record_of,
    runge_kutta_matrix,
)
from scipy.linalg import block_diag

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.adapters import PerEpisode
from pinnobs_gym.estimation.kalman import joseph_update
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.simulation.matrices import cholesky, divide
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

ASSUMED = 3e-3 / np.sqrt(2.0)
"""Process noise of `Linear` per √s that filters assume by default: 3e-3 of the scale over the
benchmark's 2 s."""


@pytest.mark.parametrize(("process_noise", "noise_std", "atol"), NOISE_OF_FILTERS)
def test_on_a_linear_system_the_ekf_is_the_kalman_filter(process_noise, noise_std, atol):
    record = linear_record()
    estimates = EKF(Linear(), noise_std, process_noise, assumed_noise=0.0).run(record)
    for i in range(record.batch):
        for k, peer in enumerate(kalman_filter(record, i, process_noise, noise_std)):
            np.testing.assert_allclose(estimates.xhat[i, k], peer.x, atol=atol)
            np.testing.assert_allclose(estimates.P[i, k], peer.P, atol=atol)
            np.testing.assert_allclose(estimates.S[i, k], peer.S, atol=atol)
            np.testing.assert_allclose(estimates.innovation[i, k], peer.y, atol=atol)


def test_without_process_noise_it_is_weighted_least_squares():
    record = linear_record(1)
    ekf = EKF(Linear(), noise_std=0.1, assumed_noise=0.0)
    estimates = ekf.run(record)
    P0_inverse = np.linalg.inv(record.prior.cov[0])
    F, Phi, rows = runge_kutta_matrix(0.1), np.eye(2), []
    for _ in range(record.num_samples):
        rows.append(H @ Phi)
        Phi = F @ Phi
    Phi = np.linalg.solve(F, Phi)  # to the last sample
    G = np.concatenate(rows)
    information = P0_inverse + G.T @ G / 0.01
    x0 = np.linalg.solve(
        information, P0_inverse @ record.prior.mean[0] + G.T @ record.y[0].ravel() / 0.01
    )
    np.testing.assert_allclose(estimates.xhat[0, -1], Phi @ x0, rtol=1e-10)
    np.testing.assert_allclose(
        estimates.P[0, -1], Phi @ np.linalg.inv(information) @ Phi.T, rtol=1e-9
    )


def test_a_missing_output_is_as_if_it_had_no_weight():
    record = linear_record(1)
    y = record.y.copy()
    y[0, 3, 0], y[0, 5] = np.nan, np.nan
    ekf = EKF(Linear(), noise_std=0.1)
    estimates = ekf.run(Record(record.t, y, record.u, record.prior))
    x, P = record.prior.mean[0], record.prior.cov[0]
    for k in range(record.num_samples):
        if k:
            F = runge_kutta_matrix(0.1)
            x, P = F @ x, F @ P @ F.T + process_covariance(ASSUMED)
        R = np.diag(np.where(np.isnan(y[0, k]), 1e12, 0.01))
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x = x + K @ (np.nan_to_num(y[0, k]) - H @ x)
        P = P - K @ H @ P
        np.testing.assert_allclose(estimates.xhat[0, k], x, atol=1e-8)
    assert (estimates.innovation[0, 5] == 0).all()


def test_josephs_form_keeps_P_symmetric_and_semidefinite():
    rng = np.random.default_rng(0)
    P = np.diag([1e8, 1e-8, 1.0])[..., None]
    x, H1, R = np.zeros((1, 3)), rng.standard_normal((1, 3, 1)), np.full((1, 1, 1), 1e-10)
    for _ in range(200):
        x, P, _ = joseph_update(x, P, np.zeros((1, 1)), H1, R)
    np.testing.assert_allclose(P[..., 0], P[..., 0].T, atol=1e-20)
    assert np.linalg.eigvalsh((P + P.swapaxes(0, 1))[..., 0] / 2).min() > -1e-12


def test_the_gate_restarts_a_filter_that_is_wrong():
    """The second output jumps for good; five samples later P is widened, as done by hand here."""
    record = linear_record(1)
    y = record.y.copy()
    y[0, 8:] += 5.0
    jump = Record(record.t, y, record.u, record.prior)
    gated = EKF(Linear(), noise_std=0.1, gate=0.9999, patience=5).run(jump)
    plain = EKF(Linear(), noise_std=0.1).run(jump)
    np.testing.assert_array_equal(gated.xhat[0, :12], plain.xhat[0, :12])
    peer = KalmanFilter(dim_x=2, dim_z=2)
    peer.x, peer.F, peer.H = plain.xhat[0, 11], runge_kutta_matrix(0.1), H
    peer.Q, peer.R = process_covariance(ASSUMED), np.eye(2) * 0.01
    peer.predict()
    peer.P = record.prior.cov[0] + np.eye(2)
    peer.update(y[0, 12])
    np.testing.assert_allclose(gated.xhat[0, 12], peer.x, atol=1e-12)
    np.testing.assert_allclose(gated.P[0, 12], peer.P, atol=1e-12)


def test_the_gate_ends_false_locks_of_the_motor():
    """With a large Q and a poor prior the filter locks on wrongly in one episode of eight or so,
    for good."""
    source = EpisodeSource("InductionMotor", condition="poor_prior", duration=0.5)
    episodes = source.play(source.draw(source.streams(range(60))))
    record, speed = source.record(episodes), episodes.x[source.setup.num_steps - 1, :, 4]
    # 1e-3 of the scale per sample.
    large = 1e-3 * np.sqrt(InductionMotor.setups["benchmark"].num_steps)
    ekfs = [EKF(source.system, assumed_noise=large, gate=gate) for gate in (None, 0.9999)]
    wrong = [abs(ekf.run(record).xhat[:, -1, 4] - speed) > 30.0 for ekf in ekfs]
    assert wrong[0].sum() >= 4
    assert not wrong[1].any()


def test_hubers_weight_enlarges_the_variance_of_an_outlier_alone():
    record = linear_record(1)
    y = record.y.copy()
    y[0, 6, 0] += 4.0
    robust = EKF(Linear(), noise_std=0.1, assumed_noise=0.0, huber=2.0)
    wild = Record(record.t, y, record.u, record.prior)
    before, after = robust.run(wild).xhat[0, 5], robust.run(wild)
    P = robust.run(wild).P[0, 5]
    F = runge_kutta_matrix(0.1)
    x, P = F @ before, F @ P @ F.T
    e = y[0, 6] - H @ x
    size = abs(e) / np.sqrt(np.diag(H @ P @ H.T) + 0.01)
    assert size[0] > 10
    assert size[1] < 2
    S = H @ P @ H.T + np.diag([0.01 * size[0] / 2, 0.01])
    np.testing.assert_allclose(after.xhat[0, 6], x + P @ H.T @ np.linalg.solve(S, e), atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gate": 1.0}, "gate=1.0; expected a probability"),
        ({"gate": 0.99, "patience": 0}, "patience=0; expected at least 1"),
        ({"huber": 0.0}, "huber=0.0; expected a number of at least 1e-30"),
        ({"huber": 1e-300}, "huber=1e-300; expected a number of at least 1e-30"),
        ({"assumed_noise": -1.0}, "assumed_noise=-1.0; expected a number of at least 0"),
        ({"process_noise": -1.0}, "process_noise=-1.0 of Linear; expected numbers of at least 0"),
        ({"noise_std": -0.1}, "noise_std=-0.1 of Linear; expected numbers of at least 0"),
    ],
)
def test_settings_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        EKF(Linear(), **options)


def test_an_indefinite_prior_is_refused():
    mean = np.zeros((2, 2))
    indefinite = np.stack([np.eye(2), np.diag([1.0, -0.5])])
    with pytest.raises(ValueError, match=r"P0 of row 1 has eigenvalue -0\.5"):
        EKF(Linear()).reset(Prior(mean, indefinite))
    with pytest.raises(ValueError, match="P0 is not symmetric"):
        EKF(Linear()).reset(Prior(mean, np.array([[[1.0, 0.5], [0.0, 1.0]]] * 2)))


@pytest.mark.parametrize("size", [1, 2, 5])
def test_dividing_by_a_covariance(size):
    rng = np.random.default_rng(0)
    root = rng.standard_normal((4, size, size))
    S = root @ root.swapaxes(1, 2) + 0.1 * np.eye(size)
    A = rng.standard_normal((4, 3, size))
    found = divide(A.transpose(1, 2, 0), S.transpose(1, 2, 0)).transpose(2, 0, 1)
    np.testing.assert_allclose(found, A @ np.linalg.inv(S), rtol=1e-9)
    L = cholesky(S.transpose(1, 2, 0)).transpose(2, 0, 1)
    np.testing.assert_allclose(L, np.linalg.cholesky(S), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", untrained())
def test_single_precision_given_is_double_precision_kept(name):
    """What is given in single precision is taken for what it is, and computed with in double."""
    record = record_of(EpisodeSource("ReverseDuffing", duration=1.0), 2)
    P0 = record.prior.cov.astype(np.float32)
    single = Record(
        record.t,
        record.y.astype(np.float32),
        record.u.astype(np.float32),
        Prior(record.prior.mean.astype(np.float32), P0),
    )
    double = Record(
        record.t,
        single.y.astype(float),
        single.u.astype(float),
        Prior(single.prior.mean.astype(float), P0.astype(float)),
    )
    own = ESTIMATORS.resolve(name)(ReverseDuffing())
    found, expected = own.run(single).xhat, own.run(double).xhat
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_open_loop_is_the_model_alone():
    record = record_of(EpisodeSource("ReverseDuffing"), 2)
    estimates = OpenLoop(ReverseDuffing()).run(record)
    x = record.prior.mean
    for k in range(1, 50):
        x = model_step(ReverseDuffing(), record.t[k - 1], record.t[k], x)
    np.testing.assert_array_equal(estimates.xhat[:, 49], x)


class FilterpyRow:
    """A filterpy filter as the adapter wants it."""

    def reset(self, xhat0, P0):
        self.filter = KalmanFilter(dim_x=2, dim_z=2)
        self.filter.x, self.filter.P = xhat0, P0
        self.filter.F, self.filter.H = runge_kutta_matrix(0.1), H
        self.filter.Q, self.filter.R = np.zeros((2, 2)), np.eye(2) * 0.01
        self.first = True

    def update(self, t, y, u):
        if not self.first:
            self.filter.predict()
        self.first = False
        self.filter.update(y)
        return self.filter.x


def test_the_adapter_runs_single_episode_objects_row_by_row():
    record = linear_record()
    adapted = PerEpisode(Linear(), make=FilterpyRow, title="filterpy").run(record)
    own = EKF(Linear(), noise_std=0.1, assumed_noise=0.0).run(record)
    np.testing.assert_allclose(adapted.xhat, own.xhat, atol=1e-12)


def test_noise_is_told_and_never_zero():
    for level, expected in ((0.3, 0.3), (None, 0.02), (0.0, 1.3e-3)):
        R = EKF(ReverseDuffing(), noise_std=level).noise.R(0.0)
        np.testing.assert_allclose(R, np.full((1, 1, 1), expected**2), rtol=1e-12)
    with pytest.raises(ValueError, match=r"noise_std of ReverseDuffing has shape \(2,\); expected"):
        EKF(ReverseDuffing(), noise_std=(0.1, 0.1))


def test_a_singular_innovation_covariance_marks_its_row_alone():
    P = np.stack([np.eye(2), np.zeros((2, 2))], axis=-1)
    H2 = np.repeat(np.eye(2)[..., None], 2, axis=-1)
    x, _, _ = joseph_update(np.zeros((2, 2)), P, np.ones((2, 2)), H2, np.zeros((2, 2, 1)))
    np.testing.assert_allclose(x[0], [1, 1])
    assert np.isnan(x[1]).all()


def test_block_diagonal_covariances_stay_apart():
    """Two copies of a system side by side are estimated as each alone."""
    prior = Prior(np.ones((1, 2)), np.diag([2.0, 3.0])[None])
    K = prior.cov[0] / (prior.cov[0] + 1)
    P = block_diag(2.0, 3.0)[..., None]
    identity = np.eye(2)[..., None]
    x, _, _ = joseph_update(prior.mean, P, np.ones((1, 2)), identity, identity)
    np.testing.assert_allclose(x[0], 1 + np.diag(K))


def short_record(name, **changes):
    source = EpisodeSource(name, **changes)
    record = record_of(source, 3)
    return source, Record(record.t[:60], record.y[:, :60], record.u[:, :60], record.prior)


@pytest.mark.parametrize("estimator", untrained())
@pytest.mark.parametrize("name", ["Academic", "InductionMotor"])
def test_a_singular_R_or_P0_is_taken(estimator, name):
    """R is never below its floor, and what the prior knows exactly stays known."""
    source, record = short_record(name)
    cls = ESTIMATORS.resolve(estimator)
    assert np.isfinite(cls(source.system, noise_std=0.0).run(record).xhat).all()
    known = Record(record.t, record.y, record.u, Prior(record.prior.mean, 0 * record.prior.cov))
    estimates = cls(source.system).run(known)
    assert np.isfinite(estimates.xhat).all()
    if estimates.P is None:  # it has no use for P0
        np.testing.assert_array_equal(estimates.xhat, cls(source.system).run(record).xhat)
    else:
        scale = np.array(source.system.scale)
        found, expected = estimates.xhat[:, 0] / scale, record.prior.mean / scale
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("estimator", untrained())
def test_an_indefinite_P0_is_refused_in_one_line(estimator):
    source, record = short_record("Academic")
    cls = ESTIMATORS.resolve(estimator)
    cov = record.prior.cov.copy()
    cov[1, 0, 0] = -1.0
    wrong = Record(record.t, record.y, record.u, Prior(record.prior.mean, cov))
    sound = cls(source.system).run(record)
    if sound.P is None:  # it has no use for P0
        np.testing.assert_array_equal(cls(source.system).run(wrong).xhat, sound.xhat)
    else:
        with pytest.raises(ValueError, match="P0 of row 1 has eigenvalue -1; expected a covari"):
            cls(source.system).run(wrong)


def test_a_semidefinite_matrix_has_a_cholesky_factor_too():
    rng = np.random.default_rng(0)
    full = rng.standard_normal((4, 4))
    thin = rng.standard_normal((4, 2))
    gaps = np.diag([1.0, 0.0, 2.0, 0.0])
    P = np.stack([full @ full.T, thin @ thin.T, gaps, 0 * gaps], axis=-1)
    L = cholesky(P, semidefinite=True)
    np.testing.assert_allclose(np.einsum("ikb,jkb->ijb", L, L), P, atol=1e-7)
    assert (L[np.triu_indices(4, 1)] == 0).all()
    with np.errstate(all="ignore"):
        assert np.isnan(cholesky(P)[..., 3]).any()
        assert np.isnan(cholesky(np.full((2, 2, 1), np.nan), semidefinite=True)).any()
