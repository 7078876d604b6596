"""Moving horizons on plants with process noise: the states of the window are all unknown."""

from dataclasses import dataclass, replace

import mpmath
import numpy as np
import pytest
from linear import A, H, Linear, linear_record
from scipy.linalg import expm
from scipy.optimize import least_squares

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.simulation.matrices import mapped
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.noise import SampledLevel
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack

DT = 0.1


@dataclass(frozen=True)
class Fast(Linear):
    """With Jacobians, and in steps so short that they are as good as exact."""

    model_step = 0.01

    def f_jacobian(self, t, x, u):
        return matrix(x, A.tolist())

    def h_jacobian(self, t, x, u):
        return matrix(x, H.tolist())


def process_covariance(L):
    """∫exp(As)LLᵀexp(Aᵀs)ds over a sample (Van Loan 1978)."""
    whole = expm(DT * np.block([[-A, L @ L.T], [np.zeros((2, 2)), A.T]]))
    return whole[2:, 2:].T @ whole[:2, 2:]


def kalman_filter(record, row, Q, R):
    """Estimates, covariances, innovations and their covariances by the textbook; R (num_samples, 2,
    2); an output that is NaN is left out."""
    F, x, P = expm(DT * A), record.prior.mean[row], record.prior.cov[row]
    result = []
    for k in range(record.num_samples):
        if k:
            x, P = F @ x, F @ P @ F.T + Q
        seen = ~np.isnan(record.y[row, k])
        C, e = H[seen], (record.y[row, k] - H @ x)
        S = H @ P @ H.T + R[k]
        K = P @ C.T @ np.linalg.inv(S[np.ix_(seen, seen)])
        x, P = x + K @ e[seen], P - K @ C @ P
        result.append((x, P, np.where(seen, e, 0.0)))
    return [np.array(part) for part in zip(*result, strict=True)]


@pytest.mark.parametrize("window", [1, 2, 7, 100])
@pytest.mark.parametrize("q", [0.0, 0.3, ((0.2,), (-0.4,))])
def test_on_a_linear_plant_it_is_the_kalman_filter(q, window):
    """With a full R, irregular gaps in the outputs, and process noise in one direction alone."""
    record = linear_record()
    record.y[1, 4:7] = np.nan
    record.y[2, 3, 0] = np.nan
    G = np.array([[0.1, 0.0], [0.05, 0.2]])
    L = np.eye(2) * q if np.isscalar(q) else np.array(q)
    mhe = MHE(Fast(), noise_std=G.tolist(), process_noise=q, assumed_noise=0.0, window=window)
    found = mhe.run(record)
    for i in range(record.batch):
        R = np.repeat((G @ G.T)[None], record.num_samples, axis=0)
        x, P, e = kalman_filter(record, i, process_covariance(L), R)
        np.testing.assert_allclose(found.xhat[i], x, atol=1e-9)
        np.testing.assert_allclose(found.P[i], P, atol=1e-9)
        np.testing.assert_allclose(found.innovation[i], e, atol=1e-9)


def test_output_noise_by_sample_is_that_of_each_sample_in_the_window():
    record = linear_record()
    std = np.random.default_rng(0).uniform(0.05, 0.5, record.y.shape)
    level = SampledLevel(record.t, std)
    for q, window in ((0.3, 5), (0.0, 5)):
        mhe = MHE(Fast(), noise_std=level, process_noise=q, assumed_noise=0.0, window=window)
        found = mhe.run(record)
        for i in range(record.batch):
            R = np.stack([np.diag(row**2) for row in std[i]])
            x, P, _ = kalman_filter(record, i, process_covariance(q * np.eye(2)), R)
            np.testing.assert_allclose(found.xhat[i], x, atol=1e-9)
            np.testing.assert_allclose(found.P[i], P, atol=1e-9)


@dataclass(frozen=True)
class Pendulum(System):
    """A pendulum, the sine of whose angle is measured."""

    state_names = ("angle", "rate")
    output_names = ("y",)
    scale = (1.0, 3.0)
    setups = {
        "benchmark": Setup(
            (1.0, 0.0),
            (1.0, 0.0),
            duration=3.0,
            dt=DT,
            noise_std=0.1,
            process_noise=((0.0,), (0.5,)),
            xhat0=(0.7, 0.2),
            P0=independent(0.5, 0.5),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -9.8 * np.sin(x[..., 0]))

    def h(self, t, x, u):
        return np.sin(x[..., :1])

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0.0, 1.0], [-9.8 * np.cos(x[..., 0]), 0.0]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[np.cos(x[..., 0]), 0.0]])


def test_full_information_finds_what_scipy_finds_over_all_states():
    system, rng, n = Pendulum(), np.random.default_rng(2), 12
    t, x = np.arange(n) * DT, [np.array([1.0, 0.0])]
    for k in range(1, n):
        end = model_step(system, t[k - 1], t[k], x[-1])
        x.append(end + np.array([0.0, 0.15 * rng.standard_normal()]))
    y = np.sin(np.array(x)[:, :1]) + 0.1 * rng.standard_normal((n, 1))
    prior = Prior.of(system, system.setups["benchmark"], 1)
    record = Record(t, y[None], np.zeros((1, n, 0)), prior)
    mhe = MHE(system, assumed_noise=0.0, window=n, steps=8)
    state = mhe.reset(prior)
    for k in range(n):
        state = mhe.update(state, float(t[k]), record.y[:, k], record.u[:, k])
    own = state.memory.whole.x[:, 0]
    Q = model_step_moments(system, mhe.noise, 0.0, DT, own[:-1])[2].transpose(2, 0, 1)

    def residuals(z):
        z = z.reshape(n, 2)
        defects = z[1:] - model_step(system, 0.0, DT, z[:-1])
        defects = np.linalg.solve(np.linalg.cholesky(Q), defects[..., None]).ravel()
        return np.concatenate(
            [(z[0] - prior.mean[0]) / 0.5, (y[:, 0] - np.sin(z[:, 0])) / 0.1, defects]
        )

    peer = least_squares(residuals, own.ravel() + 0.01, xtol=1e-14, ftol=1e-14, gtol=1e-12)
    np.testing.assert_allclose(own.ravel(), peer.x, atol=1e-6)
    # The covariance of the last state is that of the linearised least squares.
    cov = np.linalg.inv(peer.jac.T @ peer.jac)[-2:, -2:]
    np.testing.assert_allclose(state.P[0], cov, rtol=1e-4)


@dataclass(frozen=True)
class Moving(System):
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
            noise_std=0.1,
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 1.0),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0 * x[..., 0])

    def h(self, t, x, u):
        return stack(x, *[x[..., 0]] * self.ny)

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0.0, 1.0], [0.0, 0.0]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 0.0]] * self.ny)


@dataclass(frozen=True)
class Twins(Moving):
    """The same with two equal sensors."""

    output_names = ("ya", "yb")


def wide_record(system, ratio, batch=1):
    """30 samples of a point that is as far away as the prior says."""
    rng, t = np.random.default_rng(0), np.arange(30) * DT
    place = 0.8 * ratio * 0.1 - 0.5 * ratio * 0.1 * t
    y = place[:, None] + 0.1 * rng.standard_normal((batch, 30, system.ny))
    prior = Prior(np.zeros((batch, 2)), np.tile(np.eye(2) * (ratio * 0.1) ** 2, (batch, 1, 1)))
    return Record(t, y, np.zeros((batch, 30, 0)), prior)


def in_sixty_digits(record, C, q):
    """Means and standard deviations (num_samples, 2) of a Kalman filter."""
    means, stds = [], []
    with mpmath.workdps(60):
        dt, q = mpmath.mpf(DT), mpmath.mpf(q)
        F = mpmath.matrix([[1, dt], [0, 1]])
        Q = q**2 * mpmath.matrix([[dt + dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        P, x, C = (
            mpmath.matrix(record.prior.cov[0].tolist()),
            mpmath.matrix([0, 0]),
            mpmath.matrix(C),
        )
        R = mpmath.eye(C.rows) * mpmath.mpf(0.1) ** 2
        for k in range(record.num_samples):
            if k:
                x, P = F * x, F * P * F.T + Q
            K = P * C.T * (C * P * C.T + R) ** -1
            x = x + K * (mpmath.matrix(record.y[0, k].tolist()) - C * x)
            P = P - K * C * P
            means.append([float(value) for value in x])
            stds.append([float(mpmath.sqrt(P[i, i])) for i in range(2)])
    return np.array(means), np.array(stds)


@pytest.mark.parametrize("window", [1, 4, 50])
@pytest.mark.parametrize("kind", [Moving, Twins])
@pytest.mark.parametrize("q", [0.0, 1e-3])
@pytest.mark.parametrize("ratio", [1e3, 1e7, 1e9])
def test_wide_priors_are_as_in_sixty_digits(kind, q, ratio, window):
    system = kind()
    record = wide_record(system, ratio)
    means, stds = in_sixty_digits(record, [[1, 0]] * system.ny, q)
    mhe = MHE(system, noise_std=0.1, process_noise=q, assumed_noise=0.0, window=window)
    found = mhe.run(record)
    size = np.maximum(stds, 1e-14 * abs(means))  # the last digit of the numbers themselves
    assert (abs(found.xhat[0] - means) <= 0.01 * size).all()
    np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", found.P[0])), stds, rtol=0.01)
    assert (np.einsum("kii->ki", found.S[0]) > 0).all()


def test_a_wide_row_leaves_the_others_as_they_are():
    record = wide_record(Moving(), 10.0, batch=3)
    cov = record.prior.cov.copy()
    cov[1] *= 1e14
    both = Record(record.t, record.y, record.u, Prior(record.prior.mean, cov))
    for q in (0.0, 1e-2):
        mhe = MHE(Moving(), process_noise=q)
        found, alone = mhe.run(both), mhe.run(both.rows(slice(1, 2)))
        np.testing.assert_array_equal(found.xhat[[0, 2]], mhe.run(record).xhat[[0, 2]])
        np.testing.assert_allclose(found.xhat[1], alone.xhat[0], rtol=1e-12)
        np.testing.assert_allclose(found.P[1], alone.P[0], rtol=1e-9, atol=1e-12)


def test_process_noise_helps_where_there_is_some():
    """A random walk of the speed, known to the one and not to the other estimator."""
    system, rng, batch, n = Moving(), np.random.default_rng(4), 30, 200
    t, F = np.arange(n) * DT, np.array([[1.0, DT], [0.0, 1.0]])
    x = np.zeros((n, batch, 2))
    for k in range(1, n):
        x[k] = mapped(F[..., None].repeat(batch, 2), x[k - 1])
        x[k, :, 1] += np.sqrt(DT) * rng.standard_normal(batch)
    y = x[..., :1] + 0.1 * rng.standard_normal((n, batch, 1))
    prior = Prior.of(system, system.setups["benchmark"], batch)
    record = Record(t, y.swapaxes(0, 1), np.zeros((batch, n, 0)), prior)
    told = MHE(system, process_noise=((0.0,), (1.0,))).run(record)
    untold = MHE(system, process_noise=0.0).run(record)
    error, other = (np.sqrt(np.mean((e.xhat.swapaxes(0, 1) - x)[50:] ** 2)) for e in (told, untold))
    assert error < 0.3 * other
    z = (told.xhat.swapaxes(0, 1) - x) / np.sqrt(np.einsum("bkii->kbi", told.P))
    assert np.mean(z[50:] ** 2) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("name", ["ReverseDuffing", "InductionMotor"])
def test_a_window_of_one_sample_is_the_extended_filter(name):
    """On nonlinear plants with process noise, also with missing outputs, in each row by itself."""
    source = EpisodeSource(name)
    record = source.record(source.play(source.draw(source.streams(range(3))))).first_samples(40)
    y = record.y.copy()
    y[1, 5:8], y[2, 20, -1] = np.nan, np.nan
    record = replace(record, y=y)
    level = {"process_noise": (0.1 * np.array(source.system.scale)).tolist()}
    own = MHE(source.system, window=1, assumed_noise=0.0, **level).run(record)
    peer = EKF(source.system, assumed_noise=0.0, **level).run(record)
    scale = np.array(source.system.scale)
    assert (abs(own.xhat - peer.xhat) <= 1e-9 * scale).all()
    assert (abs(own.P - peer.P) <= 1e-9 * scale[:, None] * scale).all()
    longer = MHE(source.system, window=4, **level)
    together, alone = longer.run(record), longer.run(record.rows(slice(1, 2)))
    np.testing.assert_array_equal(together.xhat[1], alone.xhat[0])
    np.testing.assert_array_equal(together.P[1], alone.P[0])


@pytest.mark.parametrize("q", [0.0, 1e-2])
def test_a_wide_row_and_noise_by_sample_go_together(q):
    record = wide_record(Moving(), 10.0, batch=3)
    cov = record.prior.cov.copy()
    cov[1] *= 1e14
    both = Record(record.t, record.y, record.u, Prior(record.prior.mean, cov))
    std = np.random.default_rng(1).uniform(0.05, 0.5, record.y.shape)
    found = MHE(Moving(), noise_std=SampledLevel(record.t, std), process_noise=q).run(both)
    for i in range(3):
        level = SampledLevel(record.t, std[i : i + 1])
        alone = MHE(Moving(), noise_std=level, process_noise=q).run(both.rows(slice(i, i + 1)))
        np.testing.assert_allclose(found.xhat[i], alone.xhat[0], rtol=1e-8)
        np.testing.assert_allclose(found.P[i], alone.P[0], rtol=1e-8, atol=1e-12)
    smoother = RTSSmoother(Moving(), noise_std=SampledLevel(record.t, std), process_noise=q)
    assert np.isfinite(smoother.run(both).xhat).all()
