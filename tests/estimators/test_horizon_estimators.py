"""Estimators over stretches of record: least squares, the smoother, moving horizons."""

import numpy as np
import pytest
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
from pendulum import NoisyPendulum, pendulum_record
from scipy.optimize import least_squares

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.least_squares import linearised, root
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.simulation.matrices import identity
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.systems import SYSTEMS


def closed_form(record, row, noise_std):
    """x₀ and its covariance by the normal equations of the linear system."""
    R_inverse = np.diag(1 / np.square(noise_std))
    information, Phi = np.linalg.inv(record.prior.cov[row]), np.eye(2)
    right = information @ record.prior.mean[row]
    for k in range(record.num_samples):
        G = H @ Phi
        information = information + G.T @ R_inverse @ G
        right = right + G.T @ R_inverse @ record.y[row, k]
        Phi = runge_kutta_matrix(0.1) @ Phi
    return np.linalg.solve(information, right), np.linalg.inv(information)


def test_least_squares_are_the_normal_equations_on_a_linear_system():
    record = linear_record()
    estimates = BatchLeastSquares(Linear(), noise_std=(0.1, 0.2)).run(record)
    for i in range(record.batch):
        x0, cov = closed_form(record, i, (0.1, 0.2))
        Phi = np.eye(2)
        for k in range(record.num_samples):
            np.testing.assert_allclose(estimates.xhat[i, k], Phi @ x0, rtol=1e-9, atol=1e-10)
            np.testing.assert_allclose(estimates.P[i, k], Phi @ cov @ Phi.T, rtol=1e-9, atol=1e-14)
            Phi = runge_kutta_matrix(0.1) @ Phi


def test_least_squares_find_what_scipy_finds():
    source = EpisodeSource("ReverseDuffing", duration=3.0)
    record, duffing = record_of(source, 3), source.system
    own = BatchLeastSquares(duffing)
    found = own.run(record).xhat[:, 0]
    std = source.setup.noise_std

    for i in range(3):
        mean, std0 = record.prior.mean[i], np.sqrt(np.diag(record.prior.cov[i]))

        def residuals(x0, i=i, mean=mean, std0=std0):
            x, errors = x0, [(x0 - mean) / std0]
            for k in range(record.num_samples):
                if k:
                    x = model_step(duffing, record.t[k - 1], record.t[k], x)
                errors.append((record.y[i, k] - x[:1]) / std)
            return np.concatenate(errors)

        peer = least_squares(residuals, found[i] + 0.01, xtol=1e-12, ftol=1e-12, gtol=1e-12)
        np.testing.assert_allclose(found[i], peer.x, atol=1e-6)


def test_the_first_order_of_a_trajectory_is_that_of_finite_differences():
    source = EpisodeSource("InductionMotor", duration=0.03)
    record = record_of(source, 2)
    t, y, u = record.t, record.y.swapaxes(0, 1), record.u.swapaxes(0, 1)
    x0, noise = np.array([[1.0, 2.0, 0.3, -0.2, 90.0]] * 2), source.system.noise(0.5)
    X = identity(5, 2)
    fit = linearised(source.system, noise, t, y, u, x0, X)
    for j in range(5):
        shift = 1e-5 * source.system.scale[j] * np.eye(5)[j]
        ahead = linearised(source.system, noise, t, y, u, x0 + shift, X)
        behind = linearised(source.system, noise, t, y, u, x0 - shift, X)
        slope = (ahead.cost - behind.cost) / (2 * shift[j])
        np.testing.assert_allclose(-2 * fit.right[j], slope, rtol=1e-5)
        move = (ahead.x[-1] - behind.x[-1]) / (2 * shift[j])
        np.testing.assert_allclose(fit.X[-1][:, j].T, move, rtol=1e-5, atol=1e-7)


def test_a_root_of_a_singular_covariance():
    P = np.array([[4.0, 2.0], [2.0, 1.0]])[..., None]
    L = root(P)[..., 0]
    np.testing.assert_allclose(L @ L.T, P[..., 0], atol=1e-12)


@pytest.mark.parametrize(("process_noise", "noise_std", "atol"), NOISE_OF_FILTERS)
def test_the_smoother_is_the_textbooks_on_a_linear_system(process_noise, noise_std, atol):
    record, atol = linear_record(), max(atol, 1e-11)
    own = RTSSmoother(Linear(), noise_std, process_noise, assumed_noise=0.0).run(record)
    F, Q = runge_kutta_matrix(0.1), process_covariance(process_noise)
    for i in range(record.batch):
        peers = kalman_filter(record, i, process_noise, noise_std)
        filtered = [(peer.x.copy(), peer.P.copy()) for peer in peers]
        x, P = filtered[-1]
        for k in reversed(range(record.num_samples)):
            if k + 1 < record.num_samples:
                x_k, P_k = filtered[k]
                P_next = F @ P_k @ F.T + Q
                C = P_k @ F.T @ np.linalg.inv(P_next)
                x, P = x_k + C @ (x - F @ x_k), P_k + C @ (P - P_next) @ C.T
            np.testing.assert_allclose(own.xhat[i, k], x, atol=atol)
            np.testing.assert_allclose(own.P[i, k], P, atol=atol)


def test_the_smoother_without_process_noise_is_least_squares():
    record = linear_record()
    smoothed = RTSSmoother(Linear(), noise_std=0.1, assumed_noise=0.0).run(record)
    fitted = BatchLeastSquares(Linear(), noise_std=0.1).run(record)
    np.testing.assert_allclose(smoothed.xhat, fitted.xhat, atol=1e-9)
    np.testing.assert_allclose(smoothed.P, fitted.P, atol=1e-9)


def test_the_smoother_on_sarkkas_pendulum():
    """On single trajectories smoothers are known to reach 0.06 where filters reach 0.13."""
    x, record = pendulum_record(50)
    smoothed = RTSSmoother(NoisyPendulum(), assumed_noise=0.0).run(record).xhat
    rmse = np.sqrt(np.mean((smoothed - x)[..., 0] ** 2, axis=1))
    assert np.median(rmse) == pytest.approx(0.06, abs=0.015)


def test_the_smoother_stays_finite_where_covariances_become_singular():
    """The motor contracts: without process noise P goes to zero along some directions."""
    record = record_of(EpisodeSource("InductionMotor"), 2)
    motor = SYSTEMS.resolve("InductionMotor")()
    smoothed = RTSSmoother(motor, assumed_noise=0.0).run(record)
    assert np.isfinite(smoothed.xhat).all()
    assert np.isfinite(smoothed.P).all()
    default = RTSSmoother(motor).run(record).P
    scaled = default / np.outer(motor.scale, motor.scale)
    assert (np.linalg.eigvalsh(scaled)[..., 0] >= -1e-12 * abs(scaled).max()).all()


@pytest.mark.parametrize("window", [5, 1000])
def test_moving_horizons_are_the_kalman_filter_on_a_linear_system(window):
    """Without process noise; with a window as long as the record, and one that moves."""
    record = linear_record()
    own = MHE(Linear(), noise_std=(0.1, 0.2), assumed_noise=0.0, window=window).run(record)
    filtered = EKF(Linear(), noise_std=(0.1, 0.2), assumed_noise=0.0).run(record)
    np.testing.assert_allclose(own.xhat, filtered.xhat, atol=1e-10)
    np.testing.assert_allclose(own.P, filtered.P, atol=1e-10)
    np.testing.assert_allclose(own.innovation, filtered.innovation, atol=1e-10)


def test_a_window_of_the_whole_record_ends_at_least_squares():
    source = EpisodeSource("ReverseDuffing", duration=2.0)
    record = record_of(source, 3)
    own = MHE(source.system, window=200, steps=3).run(record).xhat[:, -1]
    fitted = BatchLeastSquares(source.system).run(record).xhat[:, -1]
    np.testing.assert_allclose(own, fitted, atol=1e-7)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (MHE, {"window": 0}, "window=0; expected at least 1"),
        (MHE, {"steps": 0}, "steps=0; expected at least 1"),
        (BatchLeastSquares, {"max_iterations": 0}, "max_iterations=0; expected at least 1"),
        (RTSSmoother, {"assumed_noise": np.nan}, "assumed_noise=nan; expected a number"),
    ],
)
def test_settings_out_of_range_are_refused(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(Linear(), **options)
