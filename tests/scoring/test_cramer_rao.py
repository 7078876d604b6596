"""The Cramér–Rao reference against its closed form."""

import numpy as np
import pytest
from linear import (
    A,
    H,
    Linear,
    Modulated,
    jacobians,
    linear_record,
    process_covariance,
    runge_kutta_matrix,
)
from scipy.linalg import expm

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.cramer_rao import cramer_rao, expected_nrmse, step_error
from pinnobs_gym.scoring.metrics import error_scores, windows
from pinnobs_gym.simulation.model import model_step_jacobian


def played(name, batch, **changes):
    """True states (batch, num_samples, nx), and the record."""
    source = EpisodeSource(name, **changes)
    episodes = source.play(source.draw(source.streams(range(batch))))
    return source, episodes.x[:-1].swapaxes(0, 1), source.record(episodes)


@pytest.mark.parametrize("name", ["ReverseDuffing", "Satellite", "InductionMotor"])
def test_it_is_the_information_of_all_outputs(name):
    """Φ(P₀⁻¹ + ΣΦᵀHᵀR⁻¹HΦ)⁻¹Φᵀ at sample 40."""
    source, x, record = played(name, 2)
    system, t, u = source.system, record.t, record.u
    P0, noise_std = record.prior.cov[0], np.broadcast_to(source.setup.noise_std, system.ny)
    R = np.diag(noise_std**2)
    found = cramer_rao(system, t[:41], x[:, :41], P0, source.noise)
    for row in range(2):
        Phi, information = np.eye(system.nx), np.linalg.inv(P0)
        for k in range(41):
            if k:
                step = (float(t[k - 1]), float(t[k]), x[row : row + 1, k - 1])
                F = model_step_jacobian(system, *step, u[:1, k - 1], u[:1, k])[1][0]
                Phi = F @ Phi
            G = system.h_jacobian(t[k], x[row, k][None], u[:1, k])[0] @ Phi
            information = information + G.T @ np.linalg.solve(R, G)
        expected = Phi @ np.linalg.inv(information) @ Phi.T
        size = np.sqrt(np.diag(expected))
        off = abs(found[row, 40] - expected) / np.outer(size, size)
        condition = np.linalg.cond(
            information * np.outer(np.sqrt(np.diag(P0)), np.sqrt(np.diag(P0)))
        )
        assert off.max() < max(1e-12, 1e-15 * condition)


def test_outputs_that_change_with_time_and_input_tell_what_they_do_then():
    """Φ(P₀⁻¹ + ΣΦᵀC(t, u)ᵀR⁻¹C(t, u)Φ)⁻¹Φᵀ of a linear system, sample by sample."""
    t, P0, R = 0.3 + np.arange(20) * 0.1, np.diag([2.0, 3.0]), np.diag([0.1, 0.2])
    x = np.random.default_rng(0).standard_normal((2, 20, 2))
    found = cramer_rao(Modulated(), t, x, P0, Modulated().noise(np.sqrt((0.1, 0.2))))
    C = jacobians(Modulated(), t, np.cos(5 * t)[:, None] + 0.3)
    assert np.ptp(C[:, 0, 0]) > 0.3
    Phi, information = np.eye(2), np.linalg.inv(P0)
    for k in range(20):
        G = C[k] @ Phi
        information = information + G.T @ np.linalg.solve(R, G)
        expected = Phi @ np.linalg.inv(information) @ Phi.T
        np.testing.assert_allclose(found[:, k], [expected, expected], rtol=1e-10)
        Phi = runge_kutta_matrix(0.1) @ Phi


def test_missing_outputs_tell_nothing_and_process_noise_is_added():
    t = np.arange(3) * 0.1
    x = np.zeros((1, 3, 2))
    P0, R, L = np.diag([2.0, 3.0]), np.array([[0.1, 0.05], [0.05, 0.2]]), [[0.5, 1.0], [-0.3, 0.7]]
    noise = Linear().noise(np.linalg.cholesky(R), L)
    missing = np.zeros((1, 3, 2), dtype=bool)
    missing[0, 0], missing[0, 1, 1] = True, True
    found = cramer_rao(Linear(), t, x, P0, noise, missing)[0]
    F, Q = runge_kutta_matrix(0.1), process_covariance(L)
    np.testing.assert_allclose(found[0], P0, rtol=1e-14)
    P = F @ P0 @ F.T + Q
    P = np.linalg.inv(np.linalg.inv(P) + H[:1].T @ H[:1] / 0.1)
    np.testing.assert_allclose(found[1], P, rtol=1e-5)  # the error of Simpson's rule
    P = F @ P @ F.T + Q
    P = np.linalg.inv(np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H)
    np.testing.assert_allclose(found[2], P, rtol=1e-5)


def test_on_a_linear_system_the_kalman_filters_covariance_is_the_reference():
    record = linear_record(1)
    P = EKF(Linear(), 0.1, 0.15, assumed_noise=0.0).run(record).P
    x = np.random.default_rng(0).standard_normal((1, record.num_samples, 2))  # any trajectory
    found = cramer_rao(Linear(), record.t, x, record.prior.cov[0], Linear().noise(0.1, 0.15))
    np.testing.assert_allclose(found, P, rtol=1e-10)


def test_expected_errors_are_those_of_errors_of_these_covariances():
    rng = np.random.default_rng(0)
    P = np.stack([np.diag([0.04, 0.09]) * (1 + k) for k in range(20)])
    error = rng.standard_normal((4000, 20, 2)) * np.sqrt(np.einsum("kii->ki", P))
    x, scale = np.zeros_like(error), (2.0, 5.0)
    scored = np.ones(x.shape, dtype=bool)
    scored[:, ::2, 0] = False
    t, covariances = np.arange(20.0), np.repeat(P[None], 4000, axis=0)
    scores = error_scores(t, x, error, scale, transient_end=7.0, scored=scored)
    for name in ("transient", "steady", "tail"):
        expected = expected_nrmse(covariances, scale, windows(t, 7.0)[name], scored)
        rms = np.sqrt(np.mean(scores[f"nrmse_{name}"] ** 2))
        assert rms == pytest.approx(expected[0], rel=0.01), name


def test_the_error_of_a_step_is_the_runge_kutta_methods():
    x = np.random.default_rng(0).standard_normal((3, 5, 2))
    dt = 0.1
    for k in range(1, 5):
        x[:, k] = x[:, k - 1] @ expm(dt * A).T
    found = step_error(Linear(), dt * np.arange(5), x)
    expected = x[:, :-1] @ (runge_kutta_matrix(dt) - expm(dt * A)).T
    np.testing.assert_allclose(found[:, 1:], expected, atol=1e-14)
    assert abs(found[:, 1:]).max() > 1e-8
    assert not found[:, 0].any()
