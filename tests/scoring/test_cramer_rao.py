"""The Cramér–Rao reference against its closed form, and exact Bayes against least squares."""

from dataclasses import dataclass, replace

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
    record_of,
    runge_kutta_matrix,
)
from scipy.linalg import expm

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.cramer_rao import cramer_rao, expected_nrmse, step_error
from pinnobs_gym.scoring.exact_bayes import exact_bayes
from pinnobs_gym.scoring.metrics import error_scores, windows
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.system import Setup
from pinnobs_gym.systems import SYSTEMS


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


@dataclass(frozen=True)
class WideLinear(Linear):
    setups = {"benchmark": replace(Linear.setups["benchmark"], x0_low=(-5, -5), x0_high=(5, 5))}


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


@dataclass(frozen=True)
class WideModulated(Modulated):
    setups = WideLinear.setups


def plain(record):
    """C, and the outputs, of `WideLinear`."""
    return np.repeat(H[None], record.num_samples, axis=0), record.y


def demodulated(record):
    """C, and the outputs less what is known of them, of `WideModulated`."""
    sine = 0.5 * np.stack([np.sin(3 * record.t), 0 * record.t], axis=-1)
    C = jacobians(WideModulated(), record.t, record.u[0])
    return C, record.y - record.u * (0.7, -1.1) - sine


@pytest.mark.parametrize(("cls", "outputs"), [(WideLinear, plain), (WideModulated, demodulated)])
def test_on_a_linear_system_exact_bayes_is_least_squares(cls, outputs):
    """With a uniform prior much wider than what one output leaves open."""
    record = record_of(EpisodeSource(cls), 3)
    setup: Setup = cls.setups["benchmark"]
    posterior = exact_bayes(cls(), setup, record, np.full(2, 0.01), draws=4000)
    C, y = outputs(record)
    assert posterior.ess[:, 2:].min() > 400
    F, Phi = runge_kutta_matrix(0.1), np.eye(2)
    information, right = np.zeros((2, 2)), np.zeros((2, 3))
    for k in range(record.num_samples):
        G = C[k] @ Phi
        information += G.T @ G / 0.01
        right += G.T @ y[:, k].T / 0.01
        if k >= 2:
            cov = Phi @ np.linalg.inv(information) @ Phi.T
            off = posterior.mean[:, k] - (Phi @ np.linalg.solve(information, right)).T
            assert (abs(off) < 0.25 * np.sqrt(np.diag(cov))).all()
            np.testing.assert_allclose(
                posterior.cov[:, k], np.repeat(cov[None], 3, axis=0), atol=0.25 * abs(cov).max()
            )
        Phi = F @ Phi


def test_no_filter_is_better_than_exact_bayes():
    source, x, record = played("ReverseDuffing", 12, duration=4.0)
    duffing = SYSTEMS.resolve("ReverseDuffing")()
    posterior = exact_bayes(duffing, source.setup, record, np.array([0.02**2]), draws=1500)
    assert np.median(posterior.ess) > 300
    errors = {}
    for name, xhat in (("bayes", posterior.mean), ("ekf", EKF(duffing).run(record).xhat)):
        errors[name] = np.sqrt(np.mean(((xhat - x) / duffing.scale) ** 2, axis=(1, 2)))
    assert np.mean(errors["bayes"]) < np.mean(errors["ekf"])
