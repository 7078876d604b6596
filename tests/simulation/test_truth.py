"""The truth and the model's step, against references that share no code with them."""

from __future__ import annotations

import re
import signal
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace
from scipy.integrate import DOP853, solve_ivp
from scipy.linalg import expm
from waiting import PATIENCE

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation import dop853
from pinnobs_gym.simulation.model import model_step, model_step_jacobian
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.simulation.truth import disturbed_truth, truth
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.academic import Academic
from pinnobs_gym.systems.harmonic_oscillator import HarmonicOscillator
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

LONGEST = {("InductionMotor", "paper"): 2.0}
"""Durations in s up to which the truth is compared, where the whole would take long."""


def test_the_coefficients_are_scipys():
    np.testing.assert_array_equal(dop853.A, DOP853.A[:12, :12])
    np.testing.assert_array_equal(dop853.B, DOP853.B)
    np.testing.assert_array_equal(dop853.C, DOP853.C[:12])


def initial_states(system: System, setup: Setup, count: int, seed: int = 5) -> np.ndarray:
    low, high = np.array(setup.x0_low), np.array(setup.x0_high)
    if setup.fixed_x0:
        return low[None].astype(float)
    drawn = np.random.default_rng(seed).uniform(low, high, (200 * count, system.nx))
    return drawn[system.admissible(drawn)][:count]


def reference(
    system: System,
    x0: np.ndarray,
    times: np.ndarray,
    method: str = "DOP853",
    rtol: float = 1e-12,
) -> np.ndarray:
    """The states (num_samples, nx) of one episode, by scipy."""

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        now = np.asarray(t)
        return system.f(now, x, system.input(now))

    atol = 1e-3 * rtol * np.array(system.scale)
    span = (times[0], times[-1])
    solution = solve_ivp(rate, span, x0, method, times, rtol=rtol, atol=atol)
    assert solution.success
    return solution.y.T


@pytest.mark.parametrize(
    ("name", "setup_name"), [(n, s) for n, cls in SYSTEMS.classes().items() for s in cls.setups]
)
def test_truth_agrees_with_scipy(name: str, setup_name: str) -> None:
    cls = SYSTEMS.resolve(name)
    duration = LONGEST.get((name, setup_name))
    system, setup = cls.configured(setup_name, duration=duration)
    x0 = initial_states(system, setup, 2)
    times = setup.times[setup.times < 0.8]
    x = truth(system, x0, times, setup.truth_step)
    few = np.unique(np.append(np.arange(0, len(times), 7), len(times) - 1))
    for row, start in enumerate(x0):
        solution = solve_between(system, start, times, few)
        error = abs(x[few, row] - solution) / system.scale
        assert error.max() < 1e-8


def solve_between(
    system: System, x0: np.ndarray, times: np.ndarray, samples: np.ndarray
) -> np.ndarray:
    """The reference at some samples: to a step's accuracy, not to that of scipy's interpolation,
    which is of a lower order than the step."""
    states = [x0]
    longest = max(1, len(samples) // 60)
    for k in range(0, len(samples) - 1, longest):
        span = times[samples[k : k + longest + 1]]
        states.extend(reference(system, states[-1], span, rtol=3e-14)[1:])
    return np.array(states)


def test_harmonic_oscillator_in_closed_form() -> None:
    system, setup = HarmonicOscillator.configured()
    x0 = initial_states(system, setup, 20)
    t = setup.times[:, None]
    p, v, squared = x0.T
    omega = np.sqrt(squared)
    position = p * np.cos(omega * t) + v / omega * np.sin(omega * t)
    velocity = v * np.cos(omega * t) - p * omega * np.sin(omega * t)
    expected = np.stack([position, velocity, np.broadcast_to(squared, position.shape)], axis=-1)
    x = truth(system, x0, setup.times, setup.truth_step)
    assert (abs(x - expected) / system.scale).max() < 1e-8


def test_academic_in_closed_form() -> None:
    system, setup = Academic.configured()
    x0 = initial_states(system, setup, 20)
    c = x0[:, 1] * np.sqrt(1 + x0[:, 0] ** 2)
    x1 = x0[:, 0] + c * setup.times[:, None]
    expected = np.stack([x1, c / np.sqrt(1 + x1**2)], axis=-1)
    x = truth(system, x0, setup.times, setup.truth_step)
    assert (abs(x - expected) / system.scale).max() < 1e-8


def test_reverse_duffing_is_periodic() -> None:
    system, setup = ReverseDuffing.configured()
    x0 = initial_states(system, setup, 5)
    energy = x0[:, 0] ** 2 / 2 + x0[:, 1] ** 4 / 4
    period = 5.244115108584239 * energy**-0.25  # 4·∫₀^√2 dv/√(2(1 − v⁴/4)), by the beta function
    for row, T in enumerate(period):
        x = truth(system, x0[row : row + 1], np.linspace(0, 3 * T, 100), setup.truth_step)
        assert (abs(x[-1] - x[0]) / system.scale).max() < 1e-8
        # and no earlier than after one period
        x = truth(system, x0[row : row + 1], np.linspace(0, T, 101), setup.truth_step)[:, 0]
        assert (abs(x[5:-5] - x[0]).max(axis=1) > 0.05).all()


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_episode_does_not_depend_on_its_batch(name: str) -> None:
    system, setup = SYSTEMS.resolve(name).configured(duration=None)
    times = setup.times[:301]
    x0 = initial_states(system, setup, 7)
    together = truth(system, x0, times, setup.truth_step)
    for row in range(len(x0)):
        alone = truth(system, x0[row : row + 1], times, setup.truth_step)
        assert (abs(together[:, row] - alone[:, 0]) / system.scale).max() < 1e-9


def test_hard_neighbour_changes_nothing() -> None:
    """A batch with an episode that needs smaller steps, and one with a stiff one."""
    system, setup = ReverseDuffing.configured()
    easy = np.array([[1.0, 0.8]])
    hard = np.array([[40.0, -9.0]])  # forty periods where the easy one has four
    times = setup.times
    alone = truth(system, easy, times, setup.truth_step)
    together = truth(system, np.concatenate([hard, easy, hard]), times, setup.truth_step)
    assert (abs(together[:, 1] - alone[:, 0]) / system.scale).max() < 1e-9
    energy = system.invariants(together[:, 0])
    assert abs(energy / energy[0] - 1).max() < 1e-8


def test_motor_load_step_is_solved_in_two_pieces() -> None:
    setup = InductionMotor.setups["benchmark"]
    torque = np.array([3.0, 40.0])
    step_time = 0.6003  # between two samples
    system = InductionMotor(load_step_time=step_time, load_step_torque=torque)  # pyright: ignore
    x0 = initial_states(InductionMotor(), setup, 2)
    times = setup.times
    x = truth(system, x0, times, setup.truth_step)
    row = 1
    before = times[times < step_time]
    first = reference(InductionMotor(), x0[row], np.append(before, step_time), rtol=3e-14)
    loaded = InductionMotor(T_L=torque[row])
    after = times[times > step_time]
    second = reference(loaded, first[-1], np.insert(after, 0, step_time), rtol=3e-14)
    expected = np.concatenate([first[:-1], second[1:]])
    # scipy's own interpolation between its steps is only of order 7
    assert (abs(x[:, row] - expected) / system.scale).max() < 2e-8
    # the loads differ after the step, and only then
    same = truth(replace(system, load_step_torque=torque[::-1].copy()), x0, times)
    until = times <= step_time
    assert (abs(same[until] - x[until]) / system.scale).max() < 1e-8
    assert abs(same[-1, 0, 4] - x[-1, 0, 4]) > 1.0


def test_breakpoint_on_a_sample() -> None:
    """The sample at the breakpoint is the same with and without the step: x is continuous."""
    setup = InductionMotor.setups["benchmark"]
    x0 = initial_states(InductionMotor(), setup, 1)
    times = setup.times[:621]
    stepped = truth(InductionMotor(load_step_time=0.6, load_step_torque=40.0), x0, times)
    plain = truth(InductionMotor(), x0, times)
    difference = (abs(stepped - plain) / InductionMotor.scale).max(axis=(1, 2))
    assert difference[:601].max() < 1e-8
    assert (difference[601:] > 1e-6).all()


BENCHMARK = Setup(
    x0_low=(1.0, 0.0),
    x0_high=(1.0, 0.0),
    xhat0=(0.0, 0.0),
    P0=independent(1.0, 1.0),
    duration=3.0,
    dt=0.05,
)


@dataclass(frozen=True)
class VanDerPol(System):
    """Stiff where mu is large."""

    mu: float = 1000.0

    state_names = ("x1", "x2")
    output_names = ("y1",)
    scale = (1.0, 1.0)
    setups: ClassVar = {"benchmark": BENCHMARK}

    def f(self, t: Any, x: Any, u: Any) -> Any:
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, x2, self.mu * (1 - x1 * x1) * x2 - x1)

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., :1]


@dataclass(frozen=True)
class TwoSprings(VanDerPol):
    """Springs of different stiffness on the two sides: f has a kink at x₁ = 0."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, x2, -x1 - 0.5 * abs(x1))


@dataclass(frozen=True)
class Blowup(VanDerPol):
    """ẋ = x²: from x₀ > 0 infinite at t = 1/x₀."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return x * x


@dataclass(frozen=True)
class Linear(VanDerPol):
    """A linear plant with an input."""

    input_hold = "linear"
    input_names = ("u1",)
    A: ClassVar = np.array([[0.0, 1.0], [-4.0, -0.3]])
    B: ClassVar = np.array([0.0, 1.0])

    def f(self, t: Any, x: Any, u: Any) -> Any:
        x1, x2 = x[..., 0], x[..., 1]
        return stack(x, x2, -4.0 * x1 - 0.3 * x2 + u[..., 0])

    def input(self, t: Any) -> Any:
        return array_namespace(t).cos(3 * t)[..., None]

    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-4.0, -0.3]])


@pytest.mark.parametrize("x0", [[[2.0, 0.0]], [[2.0, 0.0], [0.5, 0.1]]])
def test_stiff_system(x0: list[list[float]]) -> None:
    times = BENCHMARK.times
    system = VanDerPol()
    x = truth(system, np.array(x0), times)
    for row, start in enumerate(x0):
        expected = reference(system, np.array(start), times, "Radau", rtol=1e-10)
        # x2 jumps by about mu in a time of 1/mu, where the phase of the jump decides its error
        assert (abs(x[:, row] - expected) / system.scale).max() < 1e-6


def test_system_that_is_not_smooth() -> None:
    """Half oscillations of ω² = 1.5 on x₁ > 0 and of ω² = 0.5 on x₁ < 0, in closed form."""
    times = np.linspace(0, 3.0, 61)
    x = truth(TwoSprings(), np.array([[1.0, 0.0]]), times)[:, 0]
    fast, slow = np.sqrt(1.5), np.sqrt(0.5)
    crossing = np.pi / (2 * fast)
    after = times - crossing
    expected = np.where(times < crossing, np.cos(fast * times), -fast / slow * np.sin(slow * after))
    assert abs(x[:, 0] - expected).max() < 1e-8


@pytest.fixture
def limited() -> Iterator[None]:
    """A solver that stands still before a singularity fails the test, rather than hang it."""

    def stop(number: int, frame: object) -> None:
        raise TimeoutError("the solver does not come to an end")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(PATIENCE)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("limited")
def test_blow_up_names_the_initial_state() -> None:
    x0 = np.array([[0.1, -1.0], [0.75, -0.5]])
    with pytest.raises(FloatingPointError, match=r"Blowup .* x0=\[0\.75, -0\.5\]"):
        truth(Blowup(), x0, BENCHMARK.times)
    x = truth(Blowup(), x0[:1], BENCHMARK.times)  # the other row alone
    assert x[:, 0] == pytest.approx(1 / (1 / x0[0] - BENCHMARK.times[:, None]), abs=1e-9)


@dataclass(frozen=True)
class Falling(VanDerPol):
    """x'' = -1, with a sample time and a duration in whole seconds."""

    setups = {"benchmark": Setup((0.0, 1.0), (1.0, 2.0), duration=60, dt=2)}

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -1.0)


def test_sample_times_may_be_whole_numbers() -> None:
    system, t = Falling(), np.arange(31) * 2
    x0 = np.array([[0.5, 1.5], [0.1, 1.2]])
    x = truth(system, x0, t)
    assert np.allclose(x[..., 0], x0[:, 0] + x0[:, 1] * t[:, None] - t[:, None] ** 2 / 2)
    source = EpisodeSource(Falling)
    x = source.play(source.draw(source.streams(range(3)))).x
    assert np.allclose(x[-1, :, 1], x[0, :, 1] - 60)


@dataclass(frozen=True)
class Friction(VanDerPol):
    """ẍ = -sign(ẋ)/2: a block that Coulomb friction brings to rest at t = 2ẋ(0)."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -0.5 * array_namespace(x).sign(x[..., 1]))


@pytest.mark.usefixtures("limited")
@pytest.mark.parametrize("breakpoints", [(), (0.5,)])
def test_a_solver_that_cannot_go_on_says_where(breakpoints: tuple[float, ...]) -> None:
    """From x₂ = 0.75 it comes to rest at 1.5 s; until then x₁ = 0.75·t − t²/4."""

    class Piecewise(Friction):
        def breakpoints(self) -> tuple[float, ...]:
            return breakpoints

    x0 = np.array([[0.0, 0.75]])
    with pytest.raises(FloatingPointError, match=r"Piecewise from x0=.* cannot go on") as caught:
        truth(Piecewise(), x0, BENCHMARK.times)
    where = re.search(r"beyond t=(\S+) s, x=\[(\S+), (\S+)\]", str(caught.value))
    assert where is not None
    assert [float(number) for number in where.groups()] == pytest.approx(
        [1.5, 0.5625, 0.0], abs=1e-5
    )
    moving = BENCHMARK.times[BENCHMARK.times < 1.5]
    x = truth(Piecewise(), x0, moving)[:, 0]  # until it comes to rest
    assert x[:, 0] == pytest.approx(0.75 * moving - moving**2 / 4, abs=1e-9)


@pytest.mark.usefixtures("limited")
def test_an_equation_that_is_drawn_anew_at_each_call_comes_to_an_end() -> None:
    class Noisy(VanDerPol):
        def f(self, t: Any, x: Any, u: Any) -> Any:
            return -x + np.random.default_rng().standard_normal(x.shape)

    with pytest.raises(FloatingPointError, match=r"Noisy from x0=.* cannot go on"):
        truth(Noisy(), np.array([[1.0, 0.5]]), BENCHMARK.times)


def test_few_and_irregular_samples() -> None:
    system = HarmonicOscillator()
    x0 = np.array([[1.0, 0.0, 4.0]])
    for times in ([0.0, 7.0], [2.0, 2.001, 2.5, 9.0], [0.0, 1e-4]):
        x = truth(system, x0, np.array(times))[:, 0]
        elapsed = np.array(times) - times[0]
        assert x[:, 0] == pytest.approx(np.cos(2 * elapsed), abs=1e-8)
        assert x[:, 1] == pytest.approx(-2 * np.sin(2 * elapsed), abs=1e-8)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_model_step_is_of_order_four(name: str) -> None:
    """The slope of log error against log step, over one step, is that of a local error: 5."""
    system, setup = SYSTEMS.resolve(name).configured()
    x0 = initial_states(system, setup, 4)
    # as large as four steps leave errors well over rounding, and within the model's own longest
    largest = system.model_step or setup.dt
    largest *= 4.0 if system.model_step else 8.0
    coarse = type(
        f"Coarse{name}", (type(system),), {"model_step": largest, "__module__": __name__}
    )()
    steps = largest / np.array([1.0, 1.5, 2.0, 3.0])
    errors = []
    for step in steps:
        x = model_step(coarse, 0.1, 0.1 + step, x0)
        exact = [reference(system, x, np.array([0.1, 0.1 + step]), rtol=3e-14)[-1] for x in x0]
        errors.append((abs(x - np.array(exact)) / system.scale).max())
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert slope == pytest.approx(5, abs=0.4), errors


def test_model_step_takes_equal_steps_within_its_longest() -> None:
    """A step over an irregular time is several of equal length: for a motor, at most model_step."""
    system, setup = InductionMotor.configured()
    x0 = initial_states(system, setup, 3)
    long = model_step(system, 0.2, 0.2 + 1.9e-3, x0)  # four of 0.475 ms
    x = x0
    for k in range(4):
        x = model_step(system, 0.2 + k * 0.475e-3, 0.2 + (k + 1) * 0.475e-3, x)
    assert long == pytest.approx(x, rel=1e-12, abs=1e-10)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_model_step_jacobian_by_differences(name: str) -> None:
    system, setup = SYSTEMS.resolve(name).configured()
    x0 = initial_states(system, setup, 6)
    scale = np.array(system.scale)
    t0, t1 = 0.3, 0.3 + 2.5 * setup.dt  # several substeps of unequal length to dt
    x, F = model_step_jacobian(system, t0, t1, x0)
    assert x == pytest.approx(model_step(system, t0, t1, x0), rel=1e-12, abs=1e-12)
    assert F.shape == (6, system.nx, system.nx)
    for j in range(system.nx):
        shift = np.zeros(system.nx)
        shift[j] = 6e-6 * scale[j]
        ahead, behind = (model_step(system, t0, t1, x0 + s * shift) for s in (1, -1))
        column = (ahead - behind) / (2 * shift[j])
        assert (abs(F[:, :, j] - column) * scale[j] / scale).max() < 1e-7


def test_model_step_jacobian_of_a_linear_system() -> None:
    system = Linear()
    t1 = 1.0 + BENCHMARK.dt
    _, F = model_step_jacobian(system, 1.0, t1, np.array([[0.3, -0.2], [5.0, 1.0]]))
    exact = expm(Linear.A * BENCHMARK.dt)
    # one Runge-Kutta step is the series of exp(A dt) up to order four, exactly
    powers = [np.linalg.matrix_power(Linear.A * BENCHMARK.dt, k) for k in range(5)]
    series = sum(power / f for power, f in zip(powers, (1, 1, 2, 6, 24), strict=True))
    assert pytest.approx(np.stack([series, series]), abs=1e-14) == F
    assert pytest.approx(np.stack([exact, exact]), abs=1e-6) == F


def test_measured_input_is_joined_by_straight_lines() -> None:
    """The same as a plant whose input at any time is that straight line, in closed form."""
    system = Linear(measured_input=True)
    x0 = np.array([[0.3, -0.2], [1.0, 2.0]])
    u0, u1 = np.array([[1.0], [-2.0]]), np.array([[3.0], [0.5]])
    t0, t1 = 2.0, 2.0 + 2 * BENCHMARK.dt  # two substeps: the line is over both
    x = model_step(system, t0, t1, x0, u0, u1)
    # x' = Ax + B(u0 + r(t − t0)): with the input and its rate as two more states, linear
    augmented = np.zeros((4, 4))
    augmented[:2, :2], augmented[:2, 2], augmented[2, 3] = Linear.A, Linear.B, 1.0
    flow = expm(augmented * (t1 - t0))
    for row in range(2):
        rate = (u1[row, 0] - u0[row, 0]) / (t1 - t0)
        expected = flow @ [*x0[row], u0[row, 0], rate]
        assert x[row] == pytest.approx(expected[:2], abs=1e-6)
        held = flow @ [*x0[row], u0[row, 0], 0.0]
        assert abs(x[row] - held[:2]).max() > 1e-3  # neither the first input held
    jacobian_x, _ = model_step_jacobian(system, t0, t1, x0, u0, u1)
    assert jacobian_x == pytest.approx(x, abs=1e-13)


@pytest.mark.parametrize("measured", [False, True])
def test_rows_may_have_intervals_of_their_own(measured: bool) -> None:
    system = Linear(measured_input=measured)
    t0 = np.array([0.3, 2.0, 1.0])
    t1 = t0 + np.array([2.5, 2.2, 3.0]) * BENCHMARK.dt  # three substeps each
    x0 = np.array([[0.3, -0.2], [1.0, 2.0], [0.0, 1.0]])
    u0, u1 = np.array([[1.0], [-2.0], [0.5]]), np.array([[3.0], [0.5], [-1.0]])
    x, F = model_step_jacobian(system, t0, t1, x0, u0, u1)
    assert model_step(system, t0, t1, x0, u0, u1) == pytest.approx(x, abs=1e-13)
    for row in range(3):
        own = slice(row, row + 1)
        alone = model_step_jacobian(system, t0[row], t1[row], x0[own], u0[own], u1[own])
        assert x[own] == pytest.approx(alone[0], abs=1e-13)
        assert F[own] == pytest.approx(alone[1], abs=1e-13)


def test_known_input_is_taken_at_any_time() -> None:
    """Inputs at the samples are not used where the system knows its input."""
    x0 = np.array([[0.3, -0.2]])
    wrong = np.full((1, 1), 99.0)
    x = model_step(Linear(), 1.0, 1.0 + BENCHMARK.dt, x0, wrong, wrong)
    expected = reference(Linear(), x0[0], np.array([1.0, 1.0 + BENCHMARK.dt]))[-1]
    assert x[0] == pytest.approx(expected, abs=1e-6)


def test_measured_input_that_is_missing() -> None:
    with pytest.raises(ValueError, match="Linear has a measured input; u is missing"):
        model_step(Linear(measured_input=True), 0.0, 0.1, np.zeros((1, 2)))


@pytest.mark.parametrize("condition", ["nominal", "load_step"])
def test_a_truth_disturbed_by_nothing_is_the_truth(condition):
    source = EpisodeSource("InductionMotor", condition=condition)
    rngs = [np.random.default_rng(seed) for seed in range(3)]
    plant = source.condition.plant(source.system, rngs)
    x0 = np.random.default_rng(0).uniform(*source.start.corners, (3, 5))
    expected = truth(plant, x0, source.times, source.setup.truth_step)
    noise = source.system.noise(process_noise=1.0)
    draws = np.zeros((len(source.times) - 1, 2, 2, 3, 5))
    found = disturbed_truth(plant, noise, x0, source.times, draws, source.setup.truth_step)
    assert abs((found - expected) / np.array(plant.scale)).max() < 1e-8


def test_a_disturbance_that_leads_out_of_the_finite_numbers_is_told():
    system, draws = ReverseDuffing(), np.full((10, 1, 2, 1, 2), 1e200)
    noise, t = system.noise(process_noise=1.0), np.arange(11) * 0.1
    with pytest.raises(FloatingPointError, match="leaves the finite numbers from x0="):
        disturbed_truth(system, noise, np.ones((1, 2)), t, draws)


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_rates_lie_in_memory_as_the_states_do(name: str) -> None:
    """So that a filter whose batch comes last, and an env whose batch comes first, both add them
    up contiguously; and the numbers do not depend on it."""
    system, setup = SYSTEMS.resolve(name).configured()
    x = np.stack([initial_states(system, setup, 5)] * 3)
    t = np.asarray(0.1)
    u = system.input(t)
    last = np.ascontiguousarray(x.transpose(0, 2, 1)).transpose(0, 2, 1)
    for states in (x, last, x[0], last[0]):
        rates = system.f(t, states, u)
        assert rates.strides == states.strides
        np.testing.assert_array_equal(rates, system.f(t, states.copy(order="C"), u))
    A = system.f_jacobian(t, last, u)
    if type(system).f_jacobian is not System.f_jacobian:  # torch's is slower whatever its layout
        assert A.transpose(0, 2, 3, 1).flags.c_contiguous
    np.testing.assert_array_equal(A[1, 2], system.f_jacobian(t, x[1, 2], u))
