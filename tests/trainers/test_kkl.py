"""KKL observers: the dynamics of z, the labels, the fit, the three trainers."""

import math
from dataclasses import asdict, replace
from typing import get_args

import numpy as np
import pytest
import torch
from drawn import cut_off
from linear import A as PLANT
from linear import FeedThrough, H, Linear, linear_record
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_lyapunov, solve_sylvester

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.checks import check_estimator
from pinnobs_gym.estimation.export.c_files import c_files
from pinnobs_gym.estimation.learned.kkl_dynamics import (
    Dynamics,
    at_rest,
    bessel,
    enough,
    niazi,
    realised,
)
from pinnobs_gym.estimation.learned.kkl_maps import Activation, Mlp, Scaling
from pinnobs_gym.estimation.learned.perceptron import perceptron
from pinnobs_gym.estimation.learned.trained import content_of, from_content
from pinnobs_gym.estimation.takes import NotTaken
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.kkl import KKLSupervised, TrainedKKL
from pinnobs_gym.registry import TRAINERS as REGISTRY
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.simulation.truth import truth
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.checkpoint import save_checkpoint
from pinnobs_gym.training.loop import train
from trainers.kkl.fitting import Equations, Fit, Term
from trainers.kkl.labels import driven, frequency, initial_states, noise_in_z, simulated, steady
from trainers.kkl.learned_poles import STEPS, response
from trainers.kkl.pictures import figures
from trainers.kkl.samples import kept_samples
from trainers.kkl.trainer import KKLTrainer
from trainers.kkl.two_stages import TwoStageFit

TRAINERS = [name for name, cls in REGISTRY.classes().items() if issubclass(cls, KKLTrainer)]
"""Without simulated z (`KKLTrainer.labelled`) T is not found in few iterations where it changes
with time."""
POLES = (-0.5, -1.5, -4.0)
SMALL = {"trajectories": 80, "samples": 40, "iterations": 60, "width": 10, "patience": 1.0}


def trained_by(name, system, settings, *, record, noise_std=None, **options):
    """What the trainer of a name makes of settings."""
    cls = REGISTRY.resolve(name)
    config = cls.configured(settings)
    return train(cls(system, config, record=record, noise_std=noise_std), **options)


def linear_T(dynamics, plant=PLANT):
    """T(x) = Mx of the linear system: MF − AM = BH."""
    return solve_sylvester(dynamics.A, -plant, -dynamics.B @ H)


def trained_on(name, system="ReverseDuffing", noise_std=None, part=1.0, **settings):
    """Trained on the sample times of the first part of an episode."""
    options = {n: settings.pop(n) for n in ("checkpoint", "resume") if n in settings}
    game = Game.of(system)
    plant, setup, whole = game.source.system, game.source.setup, game.record([10**6])
    n = round(part * whole.num_samples)
    record = Record(whole.t[:n], whole.y[:, :n], whole.u[:, :n], whole.prior)
    told = setup.noise_std if noise_std is None else noise_std
    chosen = {**SMALL, **settings}
    trained = trained_by(name, plant, chosen, record=record, noise_std=told, **options)
    return trained, plant, setup, record


def trained_on_linear(name, cls=Linear, **settings):
    chosen = {**SMALL, "cutoff": 1.0, **settings}
    t, u = 0.1 * np.arange(80), np.zeros((1, 80, cls().nu))
    record = Record(t, np.zeros((1, 80, 2)), u, Prior(np.zeros((1, 2)), np.eye(2)[None]))
    return trained_by(name, cls(), chosen, record=record, noise_std=0.0)


# --- the dynamics of z


@pytest.mark.parametrize("poles", [(-1.0, -2.5), bessel(3, 0.7), niazi(2)])
def test_z_is_exact_for_piecewise_linear_outputs(poles):
    dynamics = realised(poles, 2)
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.05, 0.6, 12))
    y = rng.standard_normal((12, 1, 2))

    def rate(time, z):
        return dynamics.A @ z + dynamics.B @ [np.interp(time, t, y[:, 0, i]) for i in range(2)]

    z0 = rng.standard_normal(dynamics.size)
    z = dynamics.filtered(t, y, z0)
    now = z0
    for k in range(1, 12):  # piece by piece, so that the peer sees no corner
        now = solve_ivp(rate, t[k - 1 : k + 1], now, rtol=1e-10, atol=1e-12).y[:, -1]
        np.testing.assert_allclose(z[k, 0], now, atol=1e-8)
    flow = dynamics.flows(t)[-1]
    np.testing.assert_allclose(flow, expm(dynamics.A * (t[-1] - t[0])), atol=1e-12)


def test_filters_have_their_poles_and_unit_gain_at_rest():
    for poles in (bessel(4, 0.3), niazi(1), (-0.5, -2 + 1j, -2 - 1j)):
        dynamics = realised(poles, 1)
        found = np.sort_complex(np.linalg.eigvals(dynamics.A))
        np.testing.assert_allclose(found, np.sort_complex(np.array(poles)), atol=1e-9)
        rest = at_rest(dynamics, "output")
        np.testing.assert_allclose(dynamics.A @ rest + dynamics.B, 0, atol=1e-12)
    cutoff = bessel(3, 0.7)
    frequencies = 1j * 2 * np.pi * 0.7
    gain = np.prod(np.array(cutoff)) / np.prod(frequencies - np.array(cutoff))
    assert abs(gain) == pytest.approx(2**-0.5, rel=1e-6)  # −3 dB there


def test_discrete_time_is_the_euler_step():
    dynamics = realised((-1.0, -2.0), 1, "discrete")
    y = np.random.default_rng(0).standard_normal((3, 1, 1))
    z = dynamics.filtered(np.array([0.0, 0.1, 0.3]), y)
    expected = 0.1 * dynamics.B @ y[0, 0]
    np.testing.assert_allclose(z[1, 0], expected)
    expected = expected + 0.2 * (dynamics.A @ expected + dynamics.B @ y[1, 0])
    np.testing.assert_allclose(z[2, 0], expected)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: realised((-1.0, 0.5), 1), "A_z is not Hurwitz: .* real part 0.5"),
        (lambda: realised((-1.0, -1.0, -2.0), 1), "not controllable at the pole -1.* repeated"),
        (lambda: realised((-1.0, -1 + 2j), 1), "conjugate pairs"),
        (lambda: realised((-1.0, math.nan), 1), "expected finite"),
        (
            lambda: realised((-1.0, -30.0), 1, "discrete").step(0.1),
            r"not Schur in discrete time: .* of size 2",
        ),
        (lambda: enough(2, 2, 1), r"n_z=2 .*expected at least nx \+ 1 = 3"),
        (lambda: Dynamics(np.diag([-1.0, -2.0]), np.array([[1.0], [0.0]])), "not controllable"),
    ],
)
def test_what_gives_no_observer_is_told(make, message):
    with pytest.raises(ValueError, match=message) as told:
        make()
    assert "\n" not in str(told.value)


def test_noise_in_z_has_the_covariance_of_the_filter():
    dynamics = realised((-1.0, -3.0), 1)
    t, kept = 0.1 * np.arange(150), np.array([149])
    rest = at_rest(dynamics, "output")
    rng = np.random.default_rng(0)
    noise = noise_in_z(dynamics, t, np.array([0.5]), kept, 20_000, rng, rest)[0]
    flow, before, now = dynamics.step(0.1)
    # z and the last sample together are a Markov chain.
    F = np.block([[flow, before], [np.zeros((1, 3))]])
    G = np.concatenate([now, np.ones((1, 1))])
    expected = solve_discrete_lyapunov(F, 0.25 * G @ G.T)[:2, :2]
    np.testing.assert_allclose(np.cov(noise.T), expected, rtol=0.05)


# --- labels


@pytest.mark.parametrize("poles", [(-1.0, -2.0, -4.0), (-3.0, -2 + 1j, -2 - 1j)])
def test_labels_are_those_of_sylvesters_equation(poles):
    dynamics = realised(poles, 2)
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    z, stays = steady(Linear(), dynamics, x, 0.1)
    assert stays.all()
    M = linear_T(dynamics)
    np.testing.assert_allclose(z, x @ M.T, atol=1e-5)  # e⁻¹⁶ is left of where z began
    rate = x @ PLANT.T @ M.T - x @ M.T @ dynamics.A.T - x @ H.T @ dynamics.B.T
    np.testing.assert_allclose(rate, 0, atol=1e-12)


def test_labels_in_discrete_time_are_those_of_its_own_equation():
    dynamics = realised((-1.0, -2.0, -4.0), 2, "discrete")
    x = np.random.default_rng(0).uniform(-1, 1, (5, 2))
    z, _ = steady(Linear(), dynamics, x, 0.1)
    step, flow = expm(0.1 * PLANT), np.eye(6) + 0.1 * dynamics.A
    M = np.linalg.solve(
        np.kron(step.T, np.eye(6)) - np.kron(np.eye(2), flow),
        (0.1 * dynamics.B @ H).T.ravel(),
    ).reshape(2, 6)
    np.testing.assert_allclose(z, x @ M, atol=1e-5)


@pytest.mark.parametrize("start", ["output", "zero", "prior"])
def test_episodes_satisfy_T_and_forget_how_z_began(start):
    dynamics, t = realised((-1.0, -2.0, -4.0), 2), 0.01 * np.arange(800)
    x0 = np.random.default_rng(0).uniform(-1, 1, (4, 2))
    kept, xhat0 = np.array([0, 5, 799]), np.array([[0.3, 0.1]])
    found = simulated(Linear(), dynamics, t, x0, kept, start, xhat0)
    M = linear_T(dynamics)
    np.testing.assert_allclose(found.T, found.x @ M.T, atol=5e-4)
    begins = {"output": x0 @ H.T @ at_rest(dynamics, "output").T, "zero": 0, "prior": xhat0 @ M.T}
    np.testing.assert_allclose(found.z[0], begins[start] + 0 * found.z[0], atol=2e-4)
    left = np.einsum("kij,bj->kbi", found.flow, found.z[0] - found.T[0])
    np.testing.assert_allclose(found.z - found.T, left, atol=1e-9)
    np.testing.assert_allclose(found.x, truth(Linear(), x0, t)[kept], atol=1e-9)


class Clocked(Linear):
    """y = Hx + (sin 3t, 0)/2, without an input."""

    def h(self, t, x, u):
        y = super().h(t, x, u)
        return stack(x, y[..., 0] + 0.5 * np.sin(3 * t), y[..., 1])


@pytest.mark.parametrize(("cls", "through"), [(FeedThrough, (0.7, -1.1)), (Clocked, (0.0, 0.0))])
def test_z_is_driven_by_outputs_of_the_samples_own_time_and_input(cls, through):
    dynamics, t = realised((-1.0, -2.0, -4.0), 2), 0.2 + 0.01 * np.arange(300)
    x0 = np.random.default_rng(0).uniform(-1, 1, (4, 2))
    kept = np.array([0, 5, 299])
    found = simulated(cls(), dynamics, t, x0, kept, "output")
    known = np.stack([0.5 * np.sin(3 * t), 0 * t], axis=-1)
    known += (np.cos(5 * t)[:, None] + 0.3) * through
    y = truth(Linear(), x0, t) @ H.T + known[:, None]
    z = dynamics.filtered(t, y, y[0] @ at_rest(dynamics, "output").T)
    np.testing.assert_allclose(found.z, z[kept], atol=1e-9)
    assert found.T is None


def test_T_changes_with_time_if_the_equations_do():
    assert not driven(Linear())
    assert driven(Clocked())
    assert driven(FeedThrough())


@pytest.mark.parametrize("name", [n for n in TRAINERS if REGISTRY.resolve(n).labelled])
@pytest.mark.parametrize("cls", [FeedThrough, pytest.param(Clocked, marks=pytest.mark.slow)])
def test_states_are_found_behind_outputs_that_change_with_time(name, cls, tmp_path):
    system = cls()
    trained = trained_on_linear(name, cls, iterations=150, share=1.0, start="zero", samples=80)
    observer = ESTIMATORS.resolve(name)(system, 0.1, trained=trained)
    t = 0.1 * np.arange(80)
    x = truth(system, np.random.default_rng(1).uniform(-1, 1, (20, 2)), t).swapaxes(0, 1)
    u = np.repeat(system.input(t)[None], 20, axis=0)
    prior = Prior(np.zeros((20, 2)), np.repeat(np.eye(2)[None], 20, axis=0))
    xhat = observer.run(Record(t, system.h(t, x, u), u, prior)).xhat
    late = slice(20, None)
    assert np.sqrt(((xhat - x)[:, late] ** 2).mean()) < 0.15 * np.sqrt((x[:, late] ** 2).mean())
    path = tmp_path / "trained.pt"
    observer.save(path)
    again = type(observer).load(path, system)
    np.testing.assert_array_equal(
        again.trained.T(x[0], 1.0, u[0, 0]), trained.T(x[0], 1.0, u[0, 0])
    )


class Cubic(System):
    """ẋ = −x³ + x runs to infinity backward in finite time from abs x > 1."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {"benchmark": Setup((-1.0,), (1.0,), duration=5.0, dt=0.05)}

    def f(self, t, x, u):
        return stack(x, x[..., 0] - x[..., 0] ** 3)

    def h(self, t, x, u):
        return x


def test_escaping_samples_are_dropped_counted_and_refused_if_many():
    dynamics, t = realised((-1.0, -2.0), 1), 0.05 * np.arange(50)
    x0 = np.append(np.linspace(-0.9, 0.9, 19), 2.0)[:, None]
    found = simulated(Cubic(), dynamics, t, x0, np.arange(50))
    assert (found.dropped, found.drawn, found.x.shape[1]) == (1, 20, 19)
    short = {**SMALL, "iterations": 3, "cutoff": 0.5, "low": (-1.05,), "high": (1.05,)}
    t = 0.05 * np.arange(50)
    prior = Prior(np.zeros((1, 1)), np.eye(1)[None])
    record = Record(t, np.zeros((1, 50, 1)), np.zeros((1, 50, 0)), prior)
    with pytest.warns(UserWarning, match=r"of 100 initial states of Cubic escape .* left out"):
        trained = trained_by("kkl_supervised", Cubic(), short, record=record)
    assert 0 < trained.facts["dropped"] <= 10
    assert trained.facts["drawn"] == 100


class Explosive(Cubic):
    """ẋ = x³ − x runs to infinity forward from abs x > 1, and comes from there backward."""

    def f(self, t, x, u):
        return stack(x, x[..., 0] ** 3 - x[..., 0] - (x[..., 0] < -1) * 4 * x[..., 0] ** 3)


@pytest.mark.parametrize("mode", ["continuous", "discrete"])
def test_T_is_found_forward_if_many_states_escape_backward(mode):
    """At states that all reach; of its own equation Φ T(x_k) + Γ₀y_k + Γ₁y_{k+1} is T(x_{k+1})."""
    dynamics, t = realised((-1.0, -2.0), 1, mode), 0.05 * np.arange(50)
    x0 = np.linspace(-2, 2, 20)[:, None]  # 10 of them escape
    found = simulated(Cubic(), dynamics, t, x0, np.arange(50), "output")
    assert (found.dropped, found.drawn, found.reached) == (0, 20, 20)
    assert np.isnan(found.T[:, :20]).all()
    np.testing.assert_array_equal(found.x0[:20], x0)
    np.testing.assert_allclose(abs(found.x0[20:]), 1.0, atol=1e-6)  # the attractors
    # There z is at rest.
    rest = found.x0[20:] @ at_rest(dynamics, "output").T
    np.testing.assert_allclose(found.T[0, 20:], rest, atol=1e-5)
    np.testing.assert_allclose(found.T[-1, 20:], rest, atol=1e-5)
    late = {**SMALL, "iterations": 3, "cutoff": 0.5, "low": (-2.0,), "high": (2.0,), "mode": mode}
    prior = Prior(np.zeros((1, 1)), np.eye(1)[None])
    record = Record(t, np.zeros((1, 50, 1)), np.zeros((1, 50, 0)), prior)
    with pytest.warns(UserWarning, match=r"^over 10% of 100 initial states of Cubic escape .*"):
        trained = trained_by("kkl_supervised", Cubic(), late, record=record)
    assert math.isfinite(trained.facts["loss_of_T"])


def test_states_that_escape_backward_and_forward_are_refused():
    x0 = np.linspace(-2, 2, 20)[:, None]
    with pytest.raises(
        ValueError, match=r"^5 of 20 .* Explosive escape .* s, and 5 forward; .* 10%"
    ):
        simulated(Explosive(), realised((-1.0, -2.0), 1), 0.05 * np.arange(50), x0, np.arange(50))
    with pytest.raises(ValueError, match=r"^start='prior', but x̂₀ of Cubic escapes"):
        simulated(
            Cubic(),
            realised((-1.0, -2.0), 1),
            0.05 * np.arange(50),
            x0,
            np.arange(50),
            "prior",
            np.array([[2.0]]),
        )


def test_initial_states_fill_the_set():
    system = SYSTEMS.resolve("Satellite")()
    x0 = initial_states(system, None, None, 200, 0)
    assert system.admissible(x0).all()
    assert (x0[:, 2] > 0).all()  # its declared half
    box = initial_states(system, (-1, -1, 0), (1, 1, 2), 50, 0)
    hit = np.sort((box[:, 0] + 1) * 25).astype(int)
    assert (hit == np.arange(50)).all()  # one in each fiftieth
    with pytest.raises(ValueError, match="low at most high"):
        initial_states(system, (1, 1, 1), (0, 0, 0), 5, 0)
    with pytest.raises(ValueError, match="of 500 states of the box 0 are admissible"):
        initial_states(NoStates(), None, None, 5, 0)


class NoStates(Cubic):
    def admissible(self, x0):
        return np.zeros(x0.shape[:-1], dtype=bool)


def test_the_frequency_is_that_of_a_sine():
    class Spring(Linear):
        def f(self, t, x, u):
            return stack(x, 3.0 * x[..., 1], -3.0 * x[..., 0])

        setups = {"benchmark": replace(Linear.setups["benchmark"], duration=20.0, dt=0.01)}

    assert frequency(Spring()) == pytest.approx(3 / (2 * np.pi), rel=0.02)


@pytest.mark.parametrize("gap", [0, 7])
def test_kept_samples(gap):
    kept = kept_samples(200, 0, 40, gap, np.random.default_rng(0))
    assert kept[0] == 0
    assert kept[-1] == 199
    assert (np.diff(kept) > 0).all()
    if gap:
        assert sum(k + gap in kept for k in kept) >= 20
    late = kept_samples(200, 120, 1000, gap, np.random.default_rng(0))
    assert late[0] == 120


# --- networks and their fit


def a_network(activation="tanh", seed=0):
    rng = np.random.default_rng(seed)
    scalings = [Scaling.white(rng.normal(2, 3, (50, n)), np.zeros((1, n))) for n in (3, 2)]
    return Mlp(*scalings, 2, 7, activation, torch.Generator().manual_seed(seed))


def test_a_network_of_unknown_activation_is_refused():
    with pytest.raises(ValueError, match=r"^activation='sine'; expected one of tanh, silu, relu$"):
        a_network("sine")


@pytest.mark.parametrize("activation", get_args(Activation))
def test_derivatives_of_the_network(activation):
    net = a_network(activation)
    rng = np.random.default_rng(1)
    a, da = (torch.tensor(rng.standard_normal((4, 3))) for _ in range(2))
    out, J = net.jacobian(a)
    torch.testing.assert_close(out, net(a))
    for row in range(4):
        for i in range(2):
            expected = torch.autograd.grad(net(a)[row, i], net.parameters)
            flat = torch.cat([g.reshape(-1) for g in expected])
            torch.testing.assert_close(J[row, i], flat)
    h = 1e-6
    rate = (net(a + h * da) - net(a - h * da)) / (2 * h)
    torch.testing.assert_close(net.tangent(a, da)[1], rate, atol=1e-7, rtol=1e-6)
    slope = (net.jacobian(a + h * da)[1] - net.jacobian(a - h * da)[1]) / (2 * h)
    torch.testing.assert_close(net.tangent_jacobian(a, da)[1][1], slope, atol=1e-7, rtol=1e-6)


def test_a_tangent_keeps_its_gradient():
    net = a_network()
    a, da = torch.ones(2, 3, dtype=torch.float64), torch.ones(2, 3, dtype=torch.float64)
    equations = Equations([Term(a, along=da)], torch.zeros(2, 2, dtype=torch.float64))
    found = torch.autograd.grad(equations.residual(net).square().sum(), net.parameters[0])[0]
    residual, J = equations.linearised(net)
    expected = 2 * torch.einsum("bo,bop->p", residual, J)[:21].reshape(7, 3)
    assert found.abs().max() > 1e-3
    torch.testing.assert_close(found, expected)


def test_numpy_computes_what_torch_does():
    net = a_network("silu")
    a = np.random.default_rng(1).normal(2, 3, (5, 3))
    scaled = torch.tensor(net.inputs.scaled(a))
    expected = net(scaled).detach().numpy() @ net.outputs.root.T + net.outputs.mean
    np.testing.assert_allclose(perceptron(net.layers(), "silu", a), expected, atol=1e-12)


def test_gauss_newton_solves_a_regression():
    rng = np.random.default_rng(1)
    a = torch.tensor(rng.standard_normal((300, 3)))
    target = torch.stack([torch.sin(a[:, 0]) * a[:, 1], a[:, 2] ** 2], dim=-1)

    def draw(generator):
        rows = torch.randint(300, (100,), generator=generator)
        return [Equations([Term(a[rows])], target[rows])]

    def error(method, rate):
        fit = Fit(a_network(), draw, method, rate, torch.Generator().manual_seed(0))
        for k in range(150):
            fit.step(k / 150)
        return float((fit.net(a) - target).square().mean().detach())

    newton = error("gauss_newton", 0.5)
    assert newton < 2e-3
    assert newton < 0.1 * error("adam", 3e-3)


# --- trainings


@pytest.mark.parametrize("name", TRAINERS)
def test_T_of_a_linear_system_is_sylvesters(name):
    settings = {"transient": False, "start": "zero", "iterations": 150, "share": 1.0}
    trained = trained_on_linear(name, **settings)
    M = linear_T(trained.dynamics)
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    x = truth(Linear(), x, np.array([0.0, 2.0]))[-1]  # where episodes are found late
    expected = x @ M.T
    assert abs(trained.T(x) - expected).max() < 0.05 * abs(expected).max()
    record = linear_record(4)
    assert record.num_samples > 5
    xhat = trained.inverse(expected, 50.0, np.zeros(0))
    assert abs(xhat - x).max() < 0.05


@pytest.mark.parametrize("name", TRAINERS)
@pytest.mark.parametrize("system", ["ReverseDuffing", "InductionMotor"])
def test_they_estimate_and_conform(name, system, tmp_path):
    trained, plant, setup, _ = trained_on(name, system, iterations=20)
    observer = ESTIMATORS.resolve(name)(plant, setup.noise_std, trained=trained)
    check_estimator(observer)
    path = tmp_path / "trained.pt"
    observer.save(path)
    again = type(observer).load(path, plant)
    assert again.training == observer.training
    assert asdict(again.trained.clock) == asdict(trained.clock)
    record = Game.of(system).record(range(10**6 + 5, 10**6 + 8))
    np.testing.assert_array_equal(again.run(record).xhat, observer.run(record).xhat)


def test_it_is_exact_where_it_was_trained():
    """An observer of few seconds' training is far better than its prior."""
    trained, plant, setup, _ = trained_on("kkl_supervised", iterations=150, width=16)
    observer = KKLSupervised(plant, setup.noise_std, trained=trained)
    record = Game.of("ReverseDuffing").record(range(10**6 + 5, 10**6 + 13))
    xhat = observer.run(record).xhat
    error = xhat[..., :1] - record.y
    assert np.sqrt((error[:, 500:] ** 2).mean()) < 0.06  # 0.02 of it is the output's noise


@pytest.mark.parametrize("name", TRAINERS)
@pytest.mark.parametrize(
    ("system", "mode"), [("ReverseDuffing", "discrete"), ("InductionMotor", "continuous")]
)
def test_the_faithful_preset_trains(name, system, mode):
    settings = {"preset": "faithful", "iterations": 30, "depth": 2, "batch": 100, "mode": mode}
    trained, plant, _, record = trained_on(name, system, **settings)
    assert trained.start == "zero"
    assert math.isfinite(trained.loss)
    xhat = ESTIMATORS.resolve(name)(plant, trained=trained).run(record).xhat
    assert np.isfinite(xhat).all()


def test_the_faithful_preset_keeps_what_is_asked_for():
    """Every setting that is given holds, also where the preset has another: the horizon, too."""
    cls = REGISTRY.resolve("kkl_autoencoder")
    assert cls.configured({"preset": "faithful"}).horizon == 0
    chosen = {"horizon": 2.0, "mode": "continuous", "depth": 3, "noise": True}
    found = cls.configured({"preset": "faithful", **chosen})
    assert {name: getattr(found, name) for name in chosen} == chosen


@pytest.mark.parametrize(
    ("name", "stage"), [(name, "T*") for name in TRAINERS] + [("kkl_supervised", "T")]
)
def test_the_same_seed_gives_the_same_weights_and_resuming_is_exact(
    name, stage, tmp_path, monkeypatch
):
    game = Game.of("ReverseDuffing")
    system, setup, record = game.source.system, game.source.setup, game.record([10**6])
    settings = {**SMALL, "iterations": 40, "share": 1.0, "checkpoint_every": 10}
    arguments = {"record": record, "noise_std": setup.noise_std}
    whole = trained_by(name, system, settings, **arguments)
    original = TwoStageFit.step

    def step(fit):
        if (fit.stage, fit.fit.iteration) == (stage, 15):
            raise KeyboardInterrupt
        original(fit)

    monkeypatch.setattr(TwoStageFit, "step", step)
    path = tmp_path / "checkpoint.pt"
    stopped = trained_by(name, system, settings, checkpoint=path, **arguments)
    assert stopped.ending == "interrupted"
    assert stopped.iterations < whole.iterations
    monkeypatch.setattr(TwoStageFit, "step", original)
    resumed = trained_by(name, system, settings, checkpoint=path, resume=True, **arguments)
    assert resumed.ending == whole.ending == "finished"
    for network in ("encoder", "decoder"):
        for layer, other in zip(getattr(whole, network), getattr(resumed, network), strict=True):
            for a, b in zip(layer, other, strict=True):
                np.testing.assert_array_equal(a, b)
    assert resumed.iterations == whole.iterations
    other = {**settings, "seed": 1}
    with pytest.raises(ValueError, match=r"trained with seed=0; expected 1"):
        trained_by(name, system, other, checkpoint=path, resume=True, **arguments)
    with pytest.raises(ValueError, match="resume=True without a checkpoint"):
        trained_by(name, system, settings, resume=True, **arguments)


def test_a_budget_ends_the_cosine_and_the_training(ticking):
    trained, *_ = trained_on("kkl_supervised", iterations=10**6, budget=0.3)
    assert trained.iterations <= 30  # the time is looked at in each
    assert 0.3 <= trained.seconds < 0.6


def test_a_training_that_its_budget_ends_says_so_and_goes_on_with_more(ticking, tmp_path):
    path, most = tmp_path / "checkpoint.pt", {"iterations": 10**6}
    short, *_ = trained_on("kkl_supervised", budget=0.3, checkpoint=path, **most)
    assert short.ending == "budget"
    again, *_ = trained_on("kkl_supervised", budget=3.0, checkpoint=path, resume=True, **most)
    assert again.ending == "budget"
    assert again.iterations > short.iterations
    assert 3.0 <= again.seconds < 3.5


@pytest.mark.parametrize("name", TRAINERS)
def test_a_result_in_between_changes_nothing(name):
    game = Game.of("ReverseDuffing")
    cls = REGISTRY.resolve(name)
    config = cls.configured({**SMALL, "iterations": 12, "share": 1.0})
    record = game.record([10**6])
    disturbed, plain = (cls(game.source.system, config, record=record) for _ in range(2))
    disturbed.step()
    first = disturbed.result()
    assert np.isfinite(first.loss)
    ends = [train(trainer) for trainer in (disturbed, plain)]
    assert ends[0].iterations == ends[1].iterations
    for network in ("encoder", "decoder"):
        pairs = zip(*(getattr(end, network) for end in ends), strict=True)
        for layer, other in pairs:
            for a, b in zip(layer, other, strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("settings", [{"sweep": "cutoff"}, {"design": "learned", "poles": POLES}])
def test_preparations_keep_to_the_budget_too(settings, ticking):
    """A sweep and the learning of poles are steps of the training like all others."""
    trained, *_ = trained_on("kkl_supervised", budget=2.0, iterations=10**6, **settings)
    assert trained.ending == "budget"
    assert 2.0 <= trained.seconds < 2.5


def test_poles_are_learned_step_by_step_and_resumed(tmp_path):
    settings = {"design": "learned", "poles": POLES, "iterations": 5, "checkpoint_every": 1}
    whole, *_ = trained_on("kkl_supervised", **settings)
    game = Game.of("ReverseDuffing")
    cls = REGISTRY.resolve("kkl_supervised")
    make = cls(
        game.source.system,
        cls.configured({**SMALL, **settings}),
        record=game.record([10**6]),
        noise_std=game.source.setup.noise_std,
    )
    for _ in range(3):
        make.step()
    early = make.result()  # as Ctrl-C leaves it
    assert (np.linalg.eigvals(early.A).real < 0).all()
    for _ in range(STEPS - 1):
        make.step()
    path = tmp_path / "checkpoint.pt"
    save_checkpoint(make, path)
    resumed, *_ = trained_on("kkl_supervised", checkpoint=path, resume=True, **settings)
    assert resumed.iterations == whole.iterations > make.iteration
    np.testing.assert_array_equal(resumed.A, whole.A)
    for layer, other in zip(resumed.decoder, whole.decoder, strict=True):
        np.testing.assert_array_equal(layer[0], other[0])


def test_the_response_to_a_window_is_that_of_the_filter():
    dynamics = realised((-0.7, -3.0), 1)
    y = np.random.default_rng(0).standard_normal((9, 1, 1))
    z = dynamics.filtered(0.2 * np.arange(9), y)[-1, 0]
    weights = response(torch.log(torch.tensor([0.7, 3.0], dtype=torch.float64)), 0.2, 8)
    np.testing.assert_allclose(weights.numpy() @ y[:, 0, 0], z, atol=1e-12)


def test_learned_poles_are_stable_and_new():
    start = (-0.5, -1.5, -4.0)
    short = {"design": "learned", "iterations": 5}
    with pytest.raises(ValueError, match="A_z is not Hurwitz"):
        trained_on("kkl_supervised", poles=(-1.0, 2.0, -3.0), **short)
    trained, *_ = trained_on("kkl_supervised", poles=start, **short)
    found = np.sort(np.linalg.eigvals(trained.A).real)[::-1]
    assert (found < 0).all()
    assert abs(found - start).max() > 1e-3


def test_the_sweep_chooses_a_cutoff_and_draws_its_curve():
    short = {"iterations": 15, "width": 8, "part": 0.2}
    trained, plant, _, record = trained_on("kkl_supervised", sweep="cutoff", **short)
    points = trained.facts["sweep"]
    chosen = min(points, key=lambda point: point["loss"])
    assert trained.config["cutoff"] == chosen["cutoff"]
    assert len(points) == 7
    assert points[-1]["noise_gain"] > 2 * points[3]["noise_gain"]  # faster filters pass more
    drawn = figures(plant, trained, record)
    assert set(drawn) == {"radius", "error", "maps", "sweep"}
    assert not any(cut_off(figure) for figure in drawn.values())
    driven, plant, _, record = trained_on("kkl_supervised", "InductionMotor", **short)
    assert set(figures(plant, driven, record)) == {"radius"}


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"preset": "best"}, "preset='best'; expected one of default, faithful"),
        ({"cutoff": -1.0}, "cutoff=-1.0; expected None or positive Hz"),
        ({"design": "poles"}, "poles=.*for design='poles'"),
        ({"low": (0.0, 0.0)}, "expected both corners or none"),
        ({"order": 2}, r"n_z=2 .*expected at least nx \+ 1 = 3"),
        ({"design": "poles", "poles": (-1.0, -1.0, -2.0)}, "not controllable at the pole"),
        ({"design": "poles", "poles": (-1.0, 1.0, -2.0)}, "A_z is not Hurwitz"),
        (
            {"design": "poles", "poles": (-1.0, -2.0, -300.0), "mode": "discrete"},
            "not Schur in discrete time",
        ),
        ({"low": (1.0, 1.0), "high": (-1.0, 2.0)}, "low at most high"),
        ({"method": "sgd"}, "method='sgd'; expected gauss_newton or adam"),
    ],
)
def test_bad_settings_are_one_line(settings, message):
    with pytest.raises(ValueError, match=message) as told:
        trained_on("kkl_supervised", **settings)
    assert "\n" not in str(told.value)


def test_a_file_of_another_system_or_trainer_is_refused(tmp_path):
    trained, plant, *_ = trained_on("kkl_supervised", iterations=5)
    path = tmp_path / "trained.pt"
    trained.save(path)
    with pytest.raises(ValueError, match="trained with system='ReverseDuffing'; expected 'Acad"):
        KKLSupervised.load(path, SYSTEMS.resolve("Academic")())
    with pytest.raises(ValueError, match="trainer='kkl_supervised'; expected 'kkl_pinn'"):
        ESTIMATORS.resolve("kkl_pinn").load(path, plant)
    motor, machine, *_ = trained_on("kkl_supervised", "InductionMotor", iterations=5)
    motor.save(path)
    with pytest.raises(ValueError, match=r"trained with R_r=0\.15; expected 0\.3"):
        KKLSupervised.load(path, replace(machine, R_r=0.3))
    path.write_bytes(b"nothing")
    with pytest.raises(ValueError, match="damaged or no file"):
        KKLSupervised.load(path, machine)


def test_a_measured_input_is_refused():
    game = Game.of("InductionMotor")
    system, record = game.source.system, game.record([10**6])
    with pytest.raises(ValueError, match="InductionMotor has a measured input"):
        trained_by("kkl_supervised", replace(system, measured_input=True), {}, record=record)
    short = Record(record.t[:5], record.y[:, :5], record.u[:, :5], record.prior)
    with pytest.raises(ValueError, match="the record has 5 samples"):
        trained_by("kkl_supervised", system, {}, record=short)


@pytest.fixture(scope="module")
def swept():
    """A sweep that nothing interrupted, and how it was trained."""
    game = Game.of("ReverseDuffing")
    settings = {**SMALL, "iterations": 12, "width": 6, "sweep": "cutoff", "checkpoint_every": 5}
    positional = ("kkl_supervised", game.source.system, settings)
    arguments = {"record": game.record([10**6]), "noise_std": game.source.setup.noise_std}
    return trained_by(*positional, **arguments), positional, arguments


@pytest.mark.parametrize("stop", [20, 115])  # in the second fit of the sweep, and after it
def test_a_sweep_that_is_interrupted_goes_on_to_the_same_result(stop, swept, tmp_path, monkeypatch):
    whole, positional, arguments = swept
    original, made = TwoStageFit.step, []

    def step(fit):
        made.append(None)
        if len(made) == stop:
            raise KeyboardInterrupt
        original(fit)

    path = tmp_path / "checkpoint.pt"
    with monkeypatch.context() as patch:
        patch.setattr(TwoStageFit, "step", step)
        part = trained_by(*positional, checkpoint=path, **arguments)
    assert part.ending == "interrupted"
    assert (len(part.facts["sweep"]) < 7) == (stop == 20)
    again = trained_by(*positional, checkpoint=path, resume=True, **arguments)
    assert again.facts["sweep"] == whole.facts["sweep"]
    assert again.config == whole.config
    for layer, other in zip(whole.decoder, again.decoder, strict=True):
        np.testing.assert_array_equal(layer[0], other[0])


# --- outside of the region of the training


def guarded_and_plain(**settings):
    """An observer with a fallback, trained in a moment, and the same without."""
    trained, plant, setup, _ = trained_on("kkl_supervised", **settings)
    return [
        KKLSupervised(plant, setup.noise_std, trained=each)
        for each in (trained, replace(trained, region=None))
    ]


def test_estimates_are_those_of_the_filter_outside_and_of_T_star_inside(caplog):
    guarded, plain = guarded_and_plain()
    game = Game.of("ReverseDuffing", condition="x0_outside")
    record = game.record(range(20))
    found, filtered, mapped = (each.run(record) for each in (guarded, guarded.fallback, plain))
    outside = found.outside.astype(bool)
    assert outside.any()
    assert not outside.all()
    np.testing.assert_allclose(found.xhat[outside], filtered.xhat[outside], atol=1e-12)
    np.testing.assert_allclose(found.xhat[~outside], mapped.xhat[~outside], atol=1e-12)
    assert mapped.outside is None
    assert "prior" in guarded.training["knows"]
    assert "knows" not in plain.training
    with caplog.at_level("WARNING"):
        guarded.run(record)
    assert len([r for r in caplog.records if "left the region" in r.message]) <= 1


def test_no_episode_from_outside_of_the_set_diverges_and_few_samples_inside_are_outside():
    guarded, plain = guarded_and_plain(iterations=150, trajectories=300)
    for condition, most in (("nominal", 0.05), ("x0_outside", 1.0)):
        game = Game.of("ReverseDuffing", condition=condition)
        x = game.episodes(range(40)).x.swapaxes(0, 1)
        errors = []
        for observer in (guarded, plain):
            found = observer.run(game.record(range(40)))
            late = slice(3 * found.xhat.shape[1] // 4, None)
            error = (found.xhat - x[:, : found.xhat.shape[1]])[:, late]
            errors.append(np.sqrt((error**2).mean(axis=(1, 2))))
        assert guarded.run(game.record(range(40))).outside.mean() <= most
        assert errors[0].max() < 0.2
    assert (errors[1] > 0.2).mean() > 0.2  # T* alone


def test_z_has_to_be_inside_for_some_time_before_T_star_counts_again():
    """One sample far outside, of an output that jumps, and back."""
    guarded, _ = guarded_and_plain(iterations=20)
    slowest = guarded.trained.dynamics.slowest
    game = Game.of("ReverseDuffing")
    record = game.record([3])
    y = record.y.copy()
    y[:, 200] += 40.0
    found = guarded.run(replace(record, y=y))
    region, dynamics = guarded.trained.region, guarded.trained.dynamics
    z = dynamics.filtered(record.t, y.swapaxes(0, 1), y[:, 0] @ guarded.trained.rest.T)[:, 0]
    xhat = guarded.trained.inverse(z, record.t - record.t[0], record.u[0])
    left = region.outside(z, xhat)
    last = np.maximum.accumulate(np.where(left, record.t, -np.inf))
    expected = record.t - last <= 3 / slowest
    np.testing.assert_array_equal(found.outside[0].astype(bool), expected)
    assert not expected[:200].any()
    assert expected[200:210].any()
    assert not expected[210:].all()


def test_a_file_without_a_region_has_no_fallback(tmp_path):
    guarded, _ = guarded_and_plain(iterations=5)
    content = content_of(guarded.trained)
    del content["region"]
    assert from_content(TrainedKKL, content).region is None
    path = tmp_path / "trained.pt"
    guarded.save(path)
    again = KKLSupervised.load(path, guarded.system).trained.region
    np.testing.assert_array_equal(again.points, guarded.trained.region.points)
    faithful, *_ = trained_on("kkl_supervised", preset="faithful", iterations=5, depth=2)
    assert faithful.region is None


# --- inputs that are drawn


class Pushed(Linear):
    """Pushed by an input that is drawn for each episode, and held between samples."""

    input_names = ("push",)

    def f(self, t, x, u):
        return super().f(t, x, u) + stack(x, 0.0, u[..., 0])

    def draw_input(self, rng, times):
        return rng.normal(0.0, 1.0, (len(times), 1))


class PushedOnLines(Pushed):
    input_hold = "linear"


class Held(FeedThrough):
    input_hold = "previous"


@pytest.mark.parametrize("cls", [Pushed, PushedOnLines])
def test_z_is_driven_by_drawn_inputs_too(cls):
    """By the exact response to inputs that are held, or on straight lines."""
    system = cls()
    dynamics, t = realised((-1.0, -2.0, -4.0), 3), 0.1 * np.arange(30)
    x0 = np.random.default_rng(0).uniform(-1, 1, (2, 2))
    kept, rng = np.arange(30), np.random.default_rng(5)
    found = simulated(system, dynamics, t, x0, kept, "output", rng=rng)
    rng = np.random.default_rng(5)
    u = np.stack([system.draw_input(rng, t) for _ in range(2)], axis=1)
    np.testing.assert_array_equal(found.u, u)

    def rate(time, z, k, row):
        part = (time - t[k]) / 0.1 if cls.input_hold == "linear" else 0.0
        push = (1 - part) * u[k, row] + part * u[k + 1, row]
        y = (1 - (time - t[k]) / 0.1) * found.x[k, row] + (time - t[k]) / 0.1 * found.x[k + 1, row]
        return dynamics.A @ z + dynamics.B @ np.concatenate([y @ H.T, push])

    for row in range(2):
        z = found.z[0, row]
        first = np.concatenate([found.x[0, row] @ H.T, u[0, row]])
        np.testing.assert_allclose(z, at_rest(dynamics, "output") @ first, atol=1e-12)
        for k in range(29):
            z = solve_ivp(rate, t[k : k + 2], z, args=(k, row), rtol=1e-9, atol=1e-11).y[:, -1]
            np.testing.assert_allclose(found.z[k + 1, row], z, atol=1e-7)


@pytest.mark.parametrize("cls", [Pushed, PushedOnLines])
def test_states_are_found_behind_drawn_inputs(cls, tmp_path):
    system = replace(cls(), measured_input=True)
    t, u = 0.1 * np.arange(80), np.zeros((1, 80, 1))
    record = Record(t, np.zeros((1, 80, 2)), u, Prior(np.zeros((1, 2)), np.eye(2)[None]))
    settings = {**SMALL, "cutoff": 1.0, "iterations": 150}
    trained = trained_by("kkl_supervised", system, settings, record=record, noise_std=0.0)
    rng = np.random.default_rng(1)
    u = np.stack([system.draw_input(rng, t) for _ in range(20)])
    x0 = rng.uniform(-1, 1, (20, 2))
    x = truth(system, x0, t, inputs=u.swapaxes(0, 1)).swapaxes(0, 1)
    prior = Prior(np.zeros((20, 2)), np.repeat(np.eye(2)[None], 20, axis=0))
    observer = KKLSupervised(system, 0.1, trained=replace(trained, region=None))
    xhat = observer.run(Record(t, system.h(t, x, u), u, prior)).xhat
    late = slice(20, None)
    assert np.sqrt(((xhat - x)[:, late] ** 2).mean()) < 0.1 * np.sqrt((x[:, late] ** 2).mean())
    path = tmp_path / "trained.pt"
    trained.save(path)
    check_estimator(KKLSupervised.load(path, system))
    assert figures(system, trained, record) == {}
    with pytest.raises(ValueError, match=r"driven by measured inputs, too: it is not exported"):
        c_files(observer, Prior.of(system, system.setups["benchmark"], 1), "plant")


def test_measured_inputs_that_it_cannot_take_are_refused():
    t = 0.1 * np.arange(80)
    prior = Prior(np.zeros((1, 2)), np.eye(2)[None])
    record = Record(t, np.zeros((1, 80, 2)), np.zeros((1, 80, 1)), prior)
    system = replace(Pushed(), measured_input=True)
    for name, settings, line in (
        ("kkl_pinn", {}, "draws its inputs, on whose past T depends, which trainer 'kkl_pinn'"),
        ("kkl_supervised", {"start": "prior"}, r"^start='prior', but Pushed draws its inputs"),
    ):
        with pytest.raises(ValueError, match=line) as told:
            trained_by(name, system, {**SMALL, **settings}, record=record)
        assert "\n" not in str(told.value)
    trained = trained_on_linear("kkl_supervised", Held, iterations=3)
    with pytest.raises(
        NotTaken, match=r"was trained with the inputs that Held defines; for"
    ) as told:
        KKLSupervised(replace(Held(), measured_input=True), trained=trained)
    assert "\n" not in str(told.value)
