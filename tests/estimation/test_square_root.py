"""Wide priors: filters against a Kalman filter in 50 digits, and the algebra of the roots."""

from dataclasses import dataclass, replace

import mpmath
import numpy as np
import pytest
from kinds import untrained
from linear import H, Linear, linear_record, runge_kutta_matrix

from pinnobs_gym.estimation import square_root
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.matrices import divide
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, stack

NOISE, DT, SAMPLES = 0.1, 0.1, 30
EXACT = ["ekf", "ukf", "ckf", "strong_tracking_ekf", "high_gain"]
EXACT_OPTIONS = {
    "strong_tracking_ekf": {"gamma": 0.0},
    "high_gain": {"theta": 0.0},
}


@dataclass(frozen=True)
class Single(System):
    """A point that moves at a constant speed, of which the place is measured."""

    state_names = ("place", "speed")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (-1.0, -1.0),
            (1.0, 1.0),
            duration=3.0,
            dt=DT,
            noise_std=NOISE,
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 1.0),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0 * x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Twins(Single):
    """The same with two equal sensors."""

    output_names = ("ya", "yb")

    def h(self, t, x, u):
        return stack(x, x[..., 0], x[..., 0])


def wide_record(system, ratio, x0=(0.5, 0.4), batch=1):
    rng = np.random.default_rng(0)
    t = np.arange(SAMPLES) * DT
    y = (x0[0] + x0[1] * t)[:, None] + NOISE * rng.standard_normal((batch, len(t), system.ny))
    prior = Prior(np.zeros((batch, 2)), np.tile(np.eye(2) * (ratio * NOISE) ** 2, (batch, 1, 1)))
    return Record(t, y, np.zeros((batch, len(t), 0)), prior)


def in_fifty_digits(record, C, q):
    """Estimates and standard deviations, (num_samples, 2) each, of a Kalman filter with process
    noise q per √s on both states."""
    means, stds = [], []
    with mpmath.workdps(50):
        F = mpmath.matrix([[1, mpmath.mpf(DT)], [0, 1]])
        P, x = mpmath.matrix(record.prior.cov[0].tolist()), mpmath.matrix([0, 0])
        # ∫exp(As)exp(Aᵀs)ds with exp(As) = [[1, s], [0, 1]].
        h = mpmath.mpf(DT)
        Q = mpmath.mpf(q) ** 2 * mpmath.matrix([[h + h**3 / 3, h**2 / 2], [h**2 / 2, h]])
        C = mpmath.matrix(C)
        R = mpmath.eye(C.rows) * mpmath.mpf(NOISE) ** 2
        for k in range(record.num_samples):
            if k:
                x, P = F * x, F * P * F.T + Q
            K = P * C.T * (C * P * C.T + R) ** -1
            x = x + K * (mpmath.matrix(record.y[0, k].tolist()) - C * x)
            P = P - K * C * P
            means.append([float(value) for value in x])
            stds.append([float(mpmath.sqrt(P[i, i])) for i in range(2)])
    return np.array(means), np.array(stds)


@pytest.mark.parametrize("name", EXACT)
@pytest.mark.parametrize("kind", [Single, Twins])
@pytest.mark.parametrize("q", [0.0, 3e-4])
@pytest.mark.parametrize("ratio", [1e3, pytest.param(1e7, marks=pytest.mark.slow), 1e9])
def test_wide_priors_are_filtered_as_in_fifty_digits(name, kind, q, ratio):
    """Also where the truth is as far from the prior mean as the prior says."""
    system = kind()
    options = {"process_noise": q, "assumed_noise": 0.0, **EXACT_OPTIONS.get(name, {})}
    estimator = ESTIMATORS.resolve(name)(system, noise_std=NOISE, **options)
    for x0 in ((0.5, 0.4), (0.8 * ratio * NOISE, -0.5 * ratio * NOISE)):
        record = wide_record(system, ratio, x0)
        means, stds = in_fifty_digits(record, [[1, 0]] * system.ny, q)
        found = estimator.run(record)
        size = np.maximum(stds, 1e-14 * abs(means))  # the last digit of the numbers themselves
        assert (abs(found.xhat[0] - means) <= 0.01 * size).all()
        np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", found.P[0])), stds, rtol=0.01)


@pytest.mark.parametrize("name", sorted(set(untrained()) - {"particle"}))
def test_two_equal_sensors_never_give_nan(name):
    system = Twins()
    found = ESTIMATORS.resolve(name)(system, noise_std=NOISE).run(wide_record(system, 1e9))
    assert np.isfinite(found.xhat).all()
    if found.P is not None:
        assert (np.einsum("bkii->bki", found.P) >= 0).all()


@pytest.mark.parametrize("name", EXACT)
def test_a_wide_row_leaves_the_others_as_they_are(name):
    record = linear_record()
    cov = record.prior.cov.copy()
    cov[1] *= 1e14
    both = replace(record, prior=Prior(record.prior.mean, cov))
    estimator = ESTIMATORS.resolve(name)(Linear())
    found, alone = estimator.run(both), estimator.run(both.rows(slice(1, 2)))
    np.testing.assert_array_equal(found.xhat[[0, 2]], estimator.run(record).xhat[[0, 2]])
    np.testing.assert_allclose(found.xhat[1], alone.xhat[0], rtol=1e-12)
    np.testing.assert_allclose(found.P[1], alone.P[0], rtol=1e-9, atol=1e-12)


def test_the_gate_restarts_a_wide_row_too():
    record = wide_record(Single(), 1e7)
    y = record.y.copy()
    y[:, 10:] += 50.0
    ekf = EKF(Single(), noise_std=NOISE, assumed_noise=0.0, gate=0.999, patience=3)
    found = ekf.run(replace(record, y=y))
    place = np.sqrt(found.P[0, :, 0, 0])
    # The restart forgets all samples before it: the place is known as by one sample.
    assert place[12] == pytest.approx(NOISE, rel=1e-6)
    assert found.xhat[0, 12, 0] == pytest.approx(y[0, 12, 0], abs=1e-6)


def test_the_steps_by_roots_are_those_by_covariances():
    rng = np.random.default_rng(1)
    L, e, R = rng.standard_normal((4, 2, 2)), rng.standard_normal((4, 2)), np.diag([0.3, 0.7])
    P = square_root.covariance(L)
    outputs, noise = np.broadcast_to(H, (4, 2, 2)), np.broadcast_to(R, (4, 2, 2))
    step, after = square_root.updated(L, e, outputs, noise)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(step, (K @ e[..., None])[..., 0], atol=1e-12)
    np.testing.assert_allclose(
        square_root.covariance(after), P - K @ S @ K.swapaxes(1, 2), atol=1e-12
    )
    F, Q = runge_kutta_matrix(0.1), np.broadcast_to(0.1 * np.eye(2), (4, 2, 2))
    moved = square_root.compressed(F @ L, square_root.root_of(Q))
    np.testing.assert_allclose(square_root.covariance(moved), F @ P @ F.T + Q, atol=1e-12)
    X, Y = rng.standard_normal((4, 3, 7)), rng.standard_normal((4, 2, 7))
    expected = X @ Y.swapaxes(1, 2) @ np.linalg.inv(Y @ Y.swapaxes(1, 2) + R)
    np.testing.assert_allclose(square_root.gain(X, Y, noise), expected, atol=1e-12)


def test_a_quotient_without_cholesky_factor_is_that_of_the_pseudoinverse():
    regular = np.array([[2.0, 0.5], [0.5, 1.0]])
    S = np.stack([regular, np.full((2, 2), 1e16), np.full((2, 2), np.nan)], axis=-1)
    A = np.array([[1.0, 2.0], [1e16, 1e16]])[:, :, None].repeat(3, axis=2)
    found = divide(A, S)
    np.testing.assert_allclose(found[..., 0], A[..., 0] @ np.linalg.inv(regular), atol=1e-15)
    np.testing.assert_allclose(found[..., 1], A[..., 1] @ np.linalg.pinv(S[..., 1]), atol=1e-15)
    assert np.isnan(found[..., 2]).all()
