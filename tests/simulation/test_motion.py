"""Maps, stiff plants and plants with their own flow: steps, Jacobians, noise, truth, refusals."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace
from benchmarks.plants.motion import (
    Growth,
    Robertson,
    by_radau,
    grid_means,
    growth_runs,
    robertson_times,
)
from filterpy.kalman import ExtendedKalmanFilter
from kinds import FEW
from scipy.linalg import expm

from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.checks import check_estimator
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.enkf import EnKF
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.rts_smoother import RTSSmoother
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.augmented import augmented
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conditions import fitting
from pinnobs_gym.simulation.model import (
    model_step,
    model_step_jacobian,
    model_step_moments,
    noisy_model_step,
)
from pinnobs_gym.simulation.motion import Interval
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.rosenbrock import Rows, rosenbrock
from pinnobs_gym.simulation.stiff import accumulated
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.simulation.truth import truth

A = np.array([[0.9, 0.2], [-0.1, 0.8]])
BOX = Setup((-1, -1), (1, 1), duration=40, dt=1, noise_std=0.1, process_noise=(0.05, 0.2))


@dataclass(frozen=True)
class Matrix(System):
    """The map x⁺ = Ax + (0, u), whose input is known or measured."""

    state_names = ("a", "b")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    discrete = True
    setups: ClassVar = {"benchmark": BOX}

    def f(self, t, x, u):
        a, b = x[..., 0], x[..., 1]
        return stack(x, A[0, 0] * a + A[0, 1] * b, A[1, 0] * a + A[1, 1] * b + u[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, A.tolist())

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1, 0),))

    def input(self, t):
        return 0.1 * t[..., None]


def test_a_map_takes_its_steps_and_their_noise():
    system = Matrix()
    x0, noise = np.array([[0.3, -0.2], [1.0, 2.0]]), system.noise()
    x, F, Q = model_step_moments(system, noise, 2.0, 5.0, x0)
    expected, cov, LL = x0.T, np.zeros((2, 2)), np.diag([0.05**2, 0.2**2])
    for k in (2, 3, 4):
        expected = A @ expected + np.array([[0.0], [0.1 * k]])
        cov = A @ cov @ A.T + LL
    np.testing.assert_allclose(x, expected.T, rtol=0, atol=1e-14)
    np.testing.assert_allclose(F, np.repeat(np.linalg.matrix_power(A, 3)[..., None], 2, -1))
    np.testing.assert_allclose(Q[..., 0], cov, rtol=1e-13)
    np.testing.assert_allclose(model_step(system, 2.0, 5.0, x0), x, rtol=0, atol=1e-15)
    last = truth(system, x0, np.array([2.0, 3.0, 5.0]))[-1]
    np.testing.assert_allclose(last, x, rtol=0, atol=1e-15)


def test_rows_of_a_map_may_take_different_numbers_of_steps():
    system = Matrix()
    x0, noise = np.array([[0.3, -0.2], [1.0, 2.0], [0.5, 0.5]]), system.noise()
    t0, t1 = np.array([0.0, 3.0, 1.0]), np.array([4.0, 4.0, 3.0])
    x, F, Q = model_step_moments(system, noise, t0, t1, x0)
    for i in range(3):
        alone = model_step_moments(system, noise, t0[i], t1[i], x0[i : i + 1])
        assert np.array_equal(x[i], alone[0][0])
        assert np.array_equal(F[..., i], alone[1][..., 0])
        assert np.array_equal(Q[..., i], alone[2][..., 0])


def test_noise_of_a_map_has_its_covariance():
    system = Matrix()
    source = EpisodeSource(Matrix)
    _, _, Q = model_step_moments(system, system.noise(), 0.0, 3.0, np.zeros((1, 2)))
    rng = np.random.default_rng(0)
    x = noisy_model_step(
        system,
        system.noise(),
        0.0,
        3.0,
        np.zeros((20000, 1, 2)),
        None,
        None,
        lambda size: rng.standard_normal((20000, 1, size)),
    )
    np.testing.assert_allclose(np.cov(x[:, 0].T), Q[..., 0], rtol=0.05, atol=0.002)
    # The truth has the same law: errors of the model over a step are the noise of a step.
    path = source.play(source.draw(source.streams(range(200)))).x
    error = np.stack(
        [path[k + 1] - model_step(system, float(k), k + 1.0, path[k]) for k in range(40)]
    )
    np.testing.assert_allclose(error.std(axis=(0, 1)), (0.05, 0.2), rtol=0.03)


def test_an_ekf_of_the_growth_model_is_filterpys():
    _, record = growth_runs(3)
    system = Growth()
    found = EKF(system, assumed_noise=0.0).run(record)
    for row in range(3):
        peer = ExtendedKalmanFilter(1, 1)
        peer.x, peer.P = np.zeros((1, 1)), np.eye(1)
        peer.Q, peer.R = 10 * np.eye(1), np.eye(1)
        for k in range(record.num_samples):
            if k:
                x = peer.x[0, 0]
                peer.F = np.array([[0.5 + 25 * (1 - x * x) / (1 + x * x) ** 2]])
                peer.predict()
                peer.x = np.array([[x / 2 + 25 * x / (1 + x * x) + 8 * np.cos(1.2 * (k - 1))]])
            peer.update(record.y[row, k], lambda x: x / 10, lambda x: x * x / 20)
            # the filter amplifies rounding where its gain is large
            assert found.xhat[row, k, 0] == pytest.approx(peer.x[0, 0], rel=1e-10, abs=1e-10)
            assert found.P[row, k, 0, 0] == pytest.approx(peer.P[0, 0], rel=1e-10)


def test_a_particle_filter_of_the_growth_model_is_nearly_the_grid_filter():
    path, record = growth_runs(60)
    least = np.sqrt(np.mean((grid_means(record.y[..., 0]) - path[..., 0]) ** 2))
    reached = np.sqrt(np.mean((ParticleFilter(Growth()).run(record).xhat - path) ** 2))
    assert 0.98 < reached / least < 1.05


@pytest.mark.parametrize("cls", [EKF, UKF, EnKF, ParticleFilter, MHE, RTSSmoother])
def test_estimators_of_a_map_pass_their_checks(cls):
    check_estimator(cls(Matrix(), **FEW.get(cls.name, {})))


def test_a_map_passes_the_checks_of_systems_and_says_so():
    check_system(Growth)
    assert "A map, 1 step per sample." in page(Growth, "pinnobs/Growth-v0")
    text = page(Matrix, "pinnobs/Matrix-v0")
    assert "A map, 1 step per sample; the inputs of a log are held" in text


def test_times_of_a_map_are_whole_numbers():
    with pytest.raises(ValueError, match=r"dt=0\.5 of Matrix, a map; expected a whole number"):
        Matrix.configured(dt=0.5)
    names = fitting(*Matrix.configured())
    assert "dt0.5" not in names
    assert {"dt2", "mismatch10", "gap"} <= set(names)
    t = np.array([0.0, 1.0, 2.5])
    prior = Prior.of(Matrix(), BOX, 1)
    record = Record(t, np.zeros((1, 3, 1)), np.zeros((1, 3, 1)), prior)
    with pytest.raises(ValueError, match=r"a sample has t=2\.5; Matrix is a map"):
        EKF(Matrix()).run(record)
    with pytest.raises(ValueError, match=r"t=2\.5 of Matrix, a map"):
        model_step(Matrix(), 0.0, 2.5, np.zeros((1, 2)))


def test_a_mismatched_map_changes_its_change_in_a_step():
    """Where no parameter is named, x⁺ − x is multiplied, not x⁺."""
    source = EpisodeSource(Matrix, condition="mismatch10", noise_std=0.0)
    plant = source.condition.plant(Matrix(), [np.random.default_rng(0)])
    x, u = np.array([[0.3, -0.2]]), np.array([[0.5]])
    step = np.asarray(Matrix().f(0.0, x, u)) - x
    np.testing.assert_allclose((plant.f(0.0, x, u) - x) / step, plant.factors, rtol=1e-12)
    assert set(abs(plant.factors - 1).round(12).ravel()) == {0.1}


def test_constants_of_an_augmented_map_remain():
    system = augmented(Matrix(), output_bias={"y": Unknown(0.0, 1.0)})
    x = np.array([[0.3, -0.2, 0.7], [1.0, 2.0, -0.5]])
    end, F = model_step_jacobian(system, 0.0, 3.0, x)
    assert np.array_equal(end[:, 2], x[:, 2])
    np.testing.assert_allclose(end[:, :2], model_step(Matrix(), 0.0, 3.0, x[:, :2]))
    np.testing.assert_allclose(F[0, 2], [0, 0, 1])


# Stiff plants


@dataclass(frozen=True)
class Forced(System):
    """A scalar plant of time constant 1/rate driven by u: ẋ = −rate·(x − u)."""

    rate: float = 1000.0

    state_names = ("x", "slow")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    stiff = True
    setups: ClassVar = {
        "benchmark": Setup((-1, 0), (1, 1), duration=2, dt=0.1, noise_std=0.1, process_noise=0.3)
    }

    def f(self, t, x, u):
        return stack(x, -self.rate * (x[..., 0] - u[..., 0]), -x[..., 1])

    def h(self, t, x, u):
        return x.sum(-1)[..., None]

    def f_jacobian(self, t, x, u):
        return matrix(x, ((-self.rate, 0), (0, -1)))

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1, 1),))

    def input(self, t):
        xp = array_namespace(t)
        return xp.cos(3 * t)[..., None]


def forced(rate, t, x0):
    """The first state of `Forced` from x0 at 0, in closed form."""
    a, w = rate, 3.0
    particular = a * (a * np.cos(w * t) + w * np.sin(w * t)) / (a * a + w * w)
    return particular + (x0 - a * a / (a * a + w * w)) * np.exp(-a * t)


@pytest.mark.parametrize("rate", [1.0, 1e3, 1e6])
def test_a_stiff_step_is_exact_whatever_the_rate(rate):
    system = Forced(rate)
    x0 = np.array([[0.3, 1.0], [-1.0, 0.5]])
    for end in (1e-4, 0.1, 2.0):
        x, F = model_step_jacobian(system, 0.0, end, x0)
        np.testing.assert_allclose(x[:, 0], forced(rate, end, x0[:, 0]), atol=3e-7)
        np.testing.assert_allclose(x[:, 1], x0[:, 1] * np.exp(-end), atol=3e-7)
        np.testing.assert_allclose(F[1], np.diag(np.exp([-rate * end, -end])), atol=3e-7)


def test_the_method_is_of_order_four():
    """On ẋ = −x² + sin t, whose solution is that of SciPy."""

    @dataclass(frozen=True)
    class Riccati(Forced):
        def f(self, t, x, u):
            now = array_namespace(x).sin(t)
            return stack(x, now - x[..., 0] ** 2, -x[..., 1])

        def f_jacobian(self, t, x, u):
            return matrix(x, ((-2 * x[..., 0], 0), (0, -1)))

    system = Riccati()
    expected = by_radau(system, np.array([0.5, 1.0]), np.array([0.0, 1.0]))[-1]
    errors = []
    for count in (20, 40):
        x = np.array([[0.5, 1.0]])
        for k in range(count):
            rows = Rows(
                Interval(system, 0.0, 1.0, None, None), np.array([k / count]), np.array([1 / count])
            )
            x, _ = rosenbrock(rows, x)
        errors.append(abs(x[0] - expected).max())
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.2)


def test_robertson_agrees_with_radau():
    system, t = Robertson(), robertson_times()
    expected, scale = by_radau(system, np.array([1.0, 0, 0]), t), np.asarray(system.scale)
    path = truth(system, np.array([[1.0, 0, 0]]), t)[:, 0]
    assert (abs(path - expected) / scale).max() < 1e-6
    x = np.array([[1.0, 0, 0], [0.9, 2e-5, 0.1]])
    for k in range(1, len(t)):
        before = x
        x, F = model_step_jacobian(system, t[k - 1], t[k], x)
        assert (abs(x[0] - expected[k]) / scale).max() < 1e-6
        assert np.array_equal(x[1:], model_step(system, t[k - 1], t[k], before[1:]))
        # matter is conserved: the columns of F sum to one
        np.testing.assert_allclose(F.sum(axis=1), 1.0, atol=1e-5)


@pytest.mark.parametrize("cls", [EKF, UKF])
def test_filters_of_robertson_are_right(cls):
    system, t = Robertson(), robertson_times()
    path = by_radau(system, np.array([1.0, 0, 0]), t)
    batch, rng = 5, np.random.default_rng(0)
    y = path[:, 2:] + 1e-3 * rng.standard_normal((batch, len(t), 1))
    setup = system.setups["benchmark"]
    prior = Prior.of(system, setup, batch)
    found = cls(system).run(Record(t, y, np.zeros((batch, len(t), 0)), prior))
    assert np.isfinite(found.P).all()
    std = np.sqrt(np.diagonal(found.P, axis1=2, axis2=3))
    assert (abs(found.xhat - path) / std)[..., ::2].max() < 4
    assert (abs(found.xhat[:, 15:, 1] - path[15:, 1]) < 1e-6).all()
    assert (abs(found.xhat[:, -1] - path[-1]) < (0.03, 2e-7, 4e-3)).all()


@pytest.mark.parametrize("rate", [1.0, 1e4])
def test_noise_of_a_stiff_plant_is_that_of_a_linear_one(rate):
    """σ²(1 − e^(−2at))/2a, whatever the samples between, and that of ensembles and of truth."""
    system = Forced(rate)
    noise, x0 = system.noise(), np.array([[0.3, 1.0]])
    _, _F, Q = model_step_moments(system, noise, 0.0, 1.0, x0)
    a = np.array([rate, 1.0])
    expected = np.diag(0.3**2 * (1 - np.exp(-2 * a)) / (2 * a))
    np.testing.assert_allclose(Q[..., 0], expected, rtol=1e-6, atol=1e-12)
    x, _, first = model_step_moments(system, noise, 0.0, 0.3, x0)
    _, _, second = model_step_moments(system, noise, 0.3, 1.0, x)
    decay = np.diag(np.exp(-0.7 * a))
    joined = decay @ first[..., 0] @ decay + second[..., 0]
    np.testing.assert_allclose(joined, expected, rtol=1e-6, atol=1e-12)
    rng = np.random.default_rng(0)
    points = noisy_model_step(
        system,
        noise,
        0.0,
        1.0,
        np.repeat(x0[None], 300, axis=0),
        None,
        None,
        lambda size: rng.standard_normal((300, 1, size)),
    )
    np.testing.assert_allclose(points[:, 0].var(axis=0), np.diag(expected), rtol=0.3)


def test_accumulated_noise_is_that_of_the_matrix_exponential():
    """Van Loan (1978): Q and Φ from the exponential of a block matrix."""
    rng = np.random.default_rng(0)
    A = rng.standard_normal((3, 3, 4)) * np.array([0.1, 1.0, 3.0, 10.0])
    L = rng.standard_normal((3, 2))
    density = (L @ L.T)[..., None]
    length = np.array([1.0, 0.5, 0.7, 0.2])
    flow, Q = accumulated(A, density, length)
    for i in range(4):
        block = np.block([[-A[..., i], L @ L.T], [np.zeros((3, 3)), A[..., i].T]]) * length[i]
        whole = expm(block)
        np.testing.assert_allclose(flow[..., i], expm(A[..., i] * length[i]), rtol=1e-9, atol=1e-9)
        expected = whole[3:, 3:].T @ whole[:3, 3:]
        np.testing.assert_allclose(Q[..., i], expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_a_stiff_plant_plays_and_is_checked():
    check_system(Robertson)
    assert "Stiff: linearly implicit steps of controlled error." in page(Robertson, "x")
    source = EpisodeSource(Forced)
    path = source.play(source.draw(source.streams(range(100)))).x
    # Far from its start, the fast state has the variance σ²/2a about the input.
    t = source.times[1:]
    off = path[1:, :, 0] - forced(1000.0, t, 0.0)[:, None]
    assert off.std() == pytest.approx(0.3 / np.sqrt(2000), rel=0.05)


def test_a_stiff_row_that_diverges_is_marked_and_harms_no_other():
    @dataclass(frozen=True)
    class Escape(Forced):
        def f(self, t, x, u):
            return stack(x, x[..., 0] ** 2, -x[..., 1])

        def f_jacobian(self, t, x, u):
            return matrix(x, ((2 * x[..., 0], 0), (0, -1)))

    x0 = np.array([[-1.0, 1.0], [2.0, 1.0]])  # ẋ = x² escapes from 2 at 0.5 s
    x, F, _ = model_step_moments(Escape(), Escape().noise(), 0.0, 1.0, x0)
    assert np.isnan(x[1]).all()
    assert x[0, 0] == pytest.approx(-0.5, abs=1e-7)
    assert F[0, 0, 0] == pytest.approx(0.25, abs=1e-6)


# Plants with their own flow


@dataclass(frozen=True)
class Decay(System):
    """ẋ = −kx + u with its exact flow, of which one state is driven."""

    k: float = 2.0

    state_names = ("x", "v")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    setups: ClassVar = {
        "benchmark": Setup(
            (-1, -1),
            (1, 1),
            duration=4,
            dt=0.1,
            noise_std=0.1,
            process_noise=0.2,
            xhat0=(0, 0),
            P0=independent(1, 1),
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -self.k * x[..., 1] + u[..., 0])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Exact(Decay):
    """The same with its flow in closed form."""

    def flow(self, t0, t1, x, u):
        xp = array_namespace(x)
        rest, gone = u[..., 0] / self.k, xp.exp(-self.k * xp.asarray(t1 - t0))
        v = rest + (x[..., 1] - rest) * gone
        moved = rest * (t1 - t0) + (x[..., 1] - rest) * (1 - gone) / self.k
        return stack(x, x[..., 0] + moved, v)


def test_an_own_flow_moves_every_estimator():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.2, 15))
    u = rng.choice([-1.0, 1.0], (2, 15, 1))
    y = rng.standard_normal((2, 15, 1))
    prior = Prior.of(Decay(), Decay.setups["benchmark"], 2)
    record = Record(t, y, u, prior)
    for cls in (EKF, UKF, MHE, RTSSmoother):
        own, plain = (cls(kind(measured_input=True)).run(record) for kind in (Exact, Decay))
        np.testing.assert_allclose(own.xhat, plain.xhat, rtol=0, atol=1e-4)
        if own.P is not None:
            np.testing.assert_allclose(own.P, plain.P, rtol=0, atol=1e-4)


def test_the_jacobian_and_the_noise_of_an_own_flow():
    system, x = Exact(), np.array([[0.3, -0.2], [1.0, 2.0]])
    d = 0.1
    end, F, Q = model_step_moments(system, system.noise(), 1.0, 1.0 + d, x)
    gone = np.exp(-2 * d)
    phi = np.array([[1, (1 - gone) / 2], [0, gone]])
    np.testing.assert_allclose(F, np.repeat(phi[..., None], 2, -1), atol=1e-9)
    np.testing.assert_allclose(end, model_step(Decay(), 1.0, 1.0 + d, x), atol=1e-6)
    # Van Loan (1978)
    a, L = np.array([[0.0, 1.0], [0.0, -2.0]]), 0.2 * np.eye(2)
    whole = expm(np.block([[-a, L @ L.T], [np.zeros((2, 2)), a.T]]) * d)
    np.testing.assert_allclose(Q[..., 0], whole[2:, 2:].T @ whole[:2, 2:], rtol=1e-4, atol=1e-9)
    rng = np.random.default_rng(0)
    points = noisy_model_step(
        system,
        system.noise(),
        1.0,
        1.0 + d,
        np.zeros((20000, 1, 2)),
        None,
        None,
        lambda size: rng.standard_normal((20000, 1, size)),
    )
    np.testing.assert_allclose(np.cov(points[:, 0].T), Q[..., 0], rtol=0.05, atol=1e-4)


def test_an_own_jacobian_is_used():
    calls = []

    @dataclass(frozen=True)
    class Told(Exact):
        def flow_jacobian(self, t0, t1, x, u):
            calls.append(len(x))
            return super().flow_jacobian(t0, t1, x, u)

    x = np.zeros((3, 2))
    _, F = model_step_jacobian(Told(), 0.0, 0.1, x)
    assert calls == [3]
    np.testing.assert_allclose(F, model_step_jacobian(Exact(), 0.0, 0.1, x)[1])


def test_the_default_flow_is_the_models_step():
    system = Decay(measured_input=True)
    x, u = np.array([[0.3, -0.2]]), np.array([[0.7]])
    assert np.array_equal(system.flow(0.0, 0.1, x, u), model_step(system, 0.0, 0.1, x, u, u))
    _, F = model_step_jacobian(system, 0.0, 0.1, x, u, u)
    assert np.array_equal(system.flow_jacobian(0.0, 0.1, x, u), F)


def test_a_flow_is_checked_and_said():
    check_system(Exact)
    assert "By its own flow; the inputs of a log are held" in page(Exact, "x")

    @dataclass(frozen=True)
    class Wrong(Exact):
        def flow(self, t0, t1, x, u):
            return super().flow(t0, t1, x, u) + 0.01

    with pytest.warns(UserWarning, match="by its own flow.*expected at most 1e-05: a flow that"):
        check_system(Wrong)


def test_an_augmented_plant_keeps_its_own_flow():
    system = augmented(Exact(), parameters={"k": Unknown(2.0, 0.3)})
    assert system.own_flow
    x = np.array([[0.3, -0.2, 1.5], [1.0, 2.0, 2.5]])
    end = model_step(system, 0.0, 0.1, x)
    for row in range(2):
        alone = model_step(Exact(k=x[row, 2]), 0.0, 0.1, x[row : row + 1, :2])
        np.testing.assert_allclose(end[row], [*alone[0], x[row, 2]], atol=1e-15)
    disturbed = augmented(Exact(), disturbance={"v": Unknown(0.0, 1.0)})
    assert not disturbed.own_flow


@pytest.mark.parametrize(
    ("base", "attributes", "message"),
    [
        (
            Exact,
            {"input_hold": "linear"},
            "input_hold='linear', and a flow of its own.*expected 'previous'",
        ),
        (Exact, {"discrete": True}, "discrete=True, a map, and its own flow"),
        (Forced, {"discrete": True}, "discrete=True, a map, and stiff=True"),
        (Decay, {"input_hold": "next"}, "input_hold='next'; expected 'previous' or 'linear'"),
        (Decay, {"flow": lambda self, t, x: x}, r"flow\(self, t, x\); expected flow\(self, t0"),
    ],
)
def test_motions_that_do_not_agree_are_refused(base, attributes, message):
    with pytest.raises(TypeError, match=message) as caught:
        type("Odd", (base,), attributes).validate()
    assert "\n" not in str(caught.value)


def test_a_system_with_its_own_flow_can_be_simulated_with_noise():
    source = EpisodeSource(Exact)
    path = source.play(source.draw(source.streams(range(200)))).x
    error = path[1] - model_step(Exact(), 0.0, 0.1, path[0])
    _, _, Q = model_step_moments(Exact(), Exact().noise(), 0.0, 0.1, path[0, :1])
    np.testing.assert_allclose(error.std(axis=0), np.sqrt(np.diagonal(Q[..., 0])), rtol=0.15)
    assert replace(Exact(), k=3.0).own_flow
