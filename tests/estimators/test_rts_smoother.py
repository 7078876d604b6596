"""The smoother where covariances lose digits: against batch solutions in many digits."""

from dataclasses import dataclass

import mpmath
import numpy as np
import pytest

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.simulation.model import model_step_jacobian, model_step_moments
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack

DT, SAMPLES = 0.1, 40


@dataclass(frozen=True)
class Decay(System):
    """Two states whose sum decays slowly and whose difference fast; the first is measured."""

    state_names = ("x1", "x2")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (-1.0, -1.0),
            (1.0, 1.0),
            duration=4.0,
            dt=DT,
            noise_std=0.1,
            xhat0=(0.0, 0.0),
            P0=independent(1.0, 1.0),
        )
    }

    def f(self, t, x, u):
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, -4.65 * x1 + 4.35 * x2, 4.35 * x1 - 4.65 * x2)

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, [[-4.65, 4.35], [4.35, -4.65]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1.0, 0.0]])


def record_of(batch=2, spread=1.0):
    rng, t = np.random.default_rng(0), np.arange(SAMPLES) * DT
    x0 = spread * np.array([[0.8, -0.5], [-0.2, 1.1]])[:batch]
    both, apart = x0.sum(axis=1, keepdims=True) / 2, x0 @ np.array([[0.5], [-0.5]])
    y = np.exp(-0.3 * t) * both + np.exp(-9 * t) * apart
    y = (y + 0.1 * rng.standard_normal(y.shape))[..., None]
    prior = Prior(np.zeros((batch, 2)), np.tile(spread**2 * np.eye(2), (batch, 1, 1)))
    return Record(t, y, np.zeros((batch, SAMPLES, 0)), prior)


def exact(system, record, row):
    """Means and standard deviations (num_samples, 2) without process noise, in 60 digits."""
    with mpmath.workdps(60):
        _, F = model_step_jacobian(system, 0.0, DT, np.ones((1, 2)))
        F, C = mpmath.matrix(F[0].tolist()), mpmath.matrix([[1, 0]])
        information, right = mpmath.matrix(record.prior.cov[row].tolist()) ** -1, mpmath.zeros(2, 1)
        Phi = mpmath.eye(2)
        for k in range(record.num_samples):
            G = C * Phi
            information += G.T * G / mpmath.mpf(0.1) ** 2
            right += G.T * mpmath.mpf(float(record.y[row, k, 0])) / mpmath.mpf(0.1) ** 2
            Phi = F * Phi
        P = information**-1
        x, means, stds = P * right, [], []
        for _ in range(record.num_samples):
            means.append([float(value) for value in x])
            stds.append([float(mpmath.sqrt(P[i, i])) for i in range(2)])
            x, P = F * x, F * P * F.T
    return np.array(means), np.array(stds)


@pytest.mark.parametrize("spread", [1.0, 1e8])
def test_without_process_noise_a_contracting_plant_keeps_its_digits(spread):
    """The difference shrinks by 1e15 in the record: P⁻ is singular in double precision."""
    system, record = Decay(), record_of(spread=spread)
    found = RTSSmoother(system, assumed_noise=0.0).run(record)
    for row in range(2):
        means, stds = exact(system, record, row)
        size = np.maximum(stds, 1e-12 * abs(means))
        assert (abs(found.xhat[row] - means) <= (1e-10 if spread == 1 else 1e-2) * size).all()
        np.testing.assert_allclose(np.sqrt(np.einsum("kii->ki", found.P[row])), stds, rtol=1e-6)


def test_a_wide_prior_is_smoothed_as_one_that_is_wide_enough():
    """Of a prior that hides nothing, the limit is reached at a ratio of 1e6 already; with 1e9 the
    covariances alone would have lost all digits."""
    record = record_of()
    smoother = RTSSmoother(Decay(), process_noise=0.01)
    known = []
    for ratio in (1e4, 1e9):
        prior = Prior(record.prior.mean, ratio**2 * record.prior.cov)
        known.append(smoother.run(Record(record.t, record.y, record.u, prior)))
    np.testing.assert_allclose(known[1].xhat, known[0].xhat, atol=1e-6)
    np.testing.assert_allclose(known[1].P, known[0].P, rtol=1e-5)


def test_a_wide_row_leaves_the_others_as_they_are():
    record = record_of()
    cov = record.prior.cov.copy()
    cov[1] *= 1e18
    both = Record(record.t, record.y, record.u, Prior(record.prior.mean, cov))
    smoother = RTSSmoother(Decay(), process_noise=0.01)
    found, alone = smoother.run(both), smoother.run(both.rows(slice(1, 2)))
    np.testing.assert_array_equal(found.xhat[0], smoother.run(record).xhat[0])
    np.testing.assert_allclose(found.xhat[1], alone.xhat[0], rtol=1e-10, atol=1e-12)


def test_smoothing_by_roots_is_the_backward_recursion():
    """Where both can be computed, with missing outputs, on a linear and on a nonlinear plant."""
    record = record_of()
    record.y[1, 4:7] = np.nan
    smoother = RTSSmoother(Decay(), process_noise=0.05)
    source = EpisodeSource("ReverseDuffing", duration=2.0)
    other = source.record(source.play(source.draw(source.streams(range(2)))))
    duffing = RTSSmoother(source.system, noise_std=0.1, process_noise=0.05)
    for each, played in ((smoother, record), (duffing, other)):
        own, roots = each.run(played), each._by_roots(played)
        np.testing.assert_allclose(roots.xhat, own.xhat, atol=1e-12)
        np.testing.assert_allclose(roots.P, own.P, atol=1e-14)


@pytest.mark.parametrize("process_noise", [1e-4, 1e-6, 1e-8])
def test_a_contracting_plant_with_little_noise_is_smoothed_as_with_fifty_digits(process_noise):
    """The recursion of Rauch, Tung and Striebel by mpmath, with the model's own Φ and Q."""
    A = np.array([[-5.0, 3.0, 0.0], [0.0, -40.0, 2.0], [1.0, 0.0, -1.0]])

    @dataclass(frozen=True)
    class Contracting(System):
        state_names = ("a", "b", "c")
        output_names = ("y",)
        scale = (1.0, 1.0, 1.0)
        setups = {"benchmark": Setup((-1.0,) * 3, (1.0,) * 3, duration=3.0, dt=0.1, noise_std=0.1)}

        def f(self, t, x, u):
            return x @ A.T

        def h(self, t, x, u):
            return x.sum(-1, keepdims=True)

        def f_jacobian(self, t, x, u):
            return matrix(x, tuple(map(tuple, A)))

        def h_jacobian(self, t, x, u):
            return matrix(x, ((1, 1, 1),))

    system, n = Contracting(), 30
    y = 0.1 * np.random.default_rng(0).standard_normal((1, n, 1))
    prior = Prior(np.zeros((1, 3)), np.eye(3)[None])
    record = Record(0.1 * np.arange(n), y, np.zeros((1, n, 0)), prior)
    smoother = RTSSmoother(system, process_noise=process_noise, assumed_noise=0.0)
    found = smoother.run(record)
    assert found.P is not None
    for k, (x, P) in enumerate(with_fifty_digits(system, smoother.noise, record)):
        std = np.sqrt(np.diag(P))
        assert (abs(found.xhat[0, k] - x) < 1e-6 * std).all()
        np.testing.assert_allclose(np.diag(found.P[0, k]), std**2, rtol=1e-6)


def with_fifty_digits(system, noise, record):
    """Return smoothed means and covariances of a record with one output and one row."""
    with mpmath.workdps(50):
        n, R = system.nx, mpmath.mpf(float(noise.R(0.0)[0, 0, 0]))
        zero, u = np.zeros((1, n)), np.zeros((1, 0))
        H = digits(system.h_jacobian(0.0, zero, u)[0])
        x, P, steps = mpmath.matrix(n, 1), mpmath.eye(n), []
        for k, t in enumerate(record.t):
            F = before = None
            if k:
                times = float(record.t[k - 1]), float(t)
                _, F, Q = model_step_moments(system, noise, *times, zero, u, u)
                F, Q = digits(F[..., 0]), digits(np.broadcast_to(Q, (n, n, 1))[..., 0])
                x, P = F * x, F * P * F.T + Q
                before = x, P
            K = P * H.T / ((H * P * H.T)[0] + R)
            x = x + K * (mpmath.mpf(float(record.y[0, k, 0])) - (H * x)[0])
            P = P - K * H * P
            steps.append((x, P, F, before))
        smoothed = [(x, P)]
        for k in range(len(steps) - 2, -1, -1):
            _, _, F, (ahead, P_ahead) = steps[k + 1]
            x, P = steps[k][:2]
            C = P * F.T * mpmath.inverse(P_ahead)
            x_after, P_after = smoothed[-1]
            smoothed.append((x + C * (x_after - ahead), P + C * (P_after - P_ahead) * C.T))
        return [
            (np.array(x.tolist(), dtype=float)[:, 0], np.array(P.tolist(), dtype=float))
            for x, P in reversed(smoothed)
        ]


def digits(a):
    """Return an array of numbers as a matrix of mpmath."""
    return mpmath.matrix(np.asarray(a, float).tolist())
