"""Unknown constants as states: against filters of known plants, derivatives and closed forms."""

import copy
import pickle
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import sympy
import torch
from array_api_compat import array_namespace
from filterpy.kalman import KalmanFilter
from linear import A, FeedThrough, H, Linear, process_covariance, record_of

from pinnobs_gym import Setup, System, Unknown, augmented, stack, table
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring.provenance import game_hash
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.initial_set import prior_moments
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.symbolic import trace
from pinnobs_gym.simulation.system import initial_states, matrix
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.systems.satellite import Satellite


@dataclass(frozen=True)
class ByHand(Linear):
    """The same with Jacobians by hand."""

    def f_jacobian(self, t, x, u):
        return matrix(x, A.tolist())

    def h_jacobian(self, t, x, u):
        return matrix(x, H.tolist())


@dataclass(frozen=True)
class Spring(System):
    """A pendulum-like spring, k sin x, with a damping coefficient; its position is measured with a
    gain."""

    k: float = 4.0
    damping: float = 0.1
    gain: float = 1.0

    state_names = ("position", "velocity")
    output_names = ("y",)
    units = {"position": "m", "velocity": "m/s", "y": "m", "k": "1/s²"}
    scale = (1.0, 2.0)
    setups = {
        "benchmark": Setup((-1.5, -1), (1.5, 1), duration=10, dt=0.05, noise_std=0.05),
        "stiff": Setup(
            (1, 0),
            (1, 0),
            duration=1,
            dt=0.05,
            xhat0=(0.8, 0),
            P0=((1, 0.5), (0.5, 2)),
            parameters={"k": 9.0, "damping": 0.3},
        ),
    }

    def f(self, t, x, u):
        position, velocity = x[..., 0], x[..., 1]
        pull = self.k * array_namespace(x).sin(position)
        return stack(x, velocity, -pull - self.damping * velocity)

    def h(self, t, x, u):
        return stack(x, self.gain * x[..., 0])


SATELLITE = {
    "parameters": {"a1": Unknown(0.5, 0.05), "a3": Unknown(0.7, 0.1)},
    "output_bias": {"y1": Unknown(0.1, 0.2)},
    "disturbance": {"x2": Unknown(0.0, 0.05)},
}


def runge_kutta_of(A, dt):
    """What the classical Runge-Kutta method does to x' = Ax."""
    h = dt * A
    terms = [np.eye(len(A))]
    for k in range(1, 5):
        terms.append(terms[-1] @ h / k)
    return sum(terms)


@pytest.mark.parametrize(("share", "atol"), [(0.0, 1e-10), (0.03, 1e-7)])
@pytest.mark.parametrize("plant", [Linear(), ByHand()], ids=["automatic", "by hand"])
def test_bias_and_disturbance_of_a_linear_plant_are_the_kalman_filters(plant, share, atol):
    """With process noise as far as Simpson's rule for Q goes."""
    system = augmented(
        plant,
        output_bias={"y2": Unknown(0.5, 2.0)},
        disturbance={"x2": Unknown(-0.3, 1.0)},
    )
    assert system.state_names == ("x1", "x2", "bias_y2", "disturbance_x2")
    record = record_of(EpisodeSource(type(system)), 3)
    L = np.diag(share * np.array([1.0, 1.0, 2.0, 1.0]))
    found = EKF(system, process_noise=L.tolist(), assumed_noise=0.0).run(record)
    F, C = np.zeros((4, 4)), np.zeros((2, 4))
    F[:2, :2], F[1, 3], C[:, :2], C[1, 2] = A, 1.0, H, 1.0
    for row in range(3):
        peer = KalmanFilter(dim_x=4, dim_z=2)
        peer.x = np.array([0.3, -0.2, 0.5, -0.3])
        peer.P = np.diag(np.square([0.8, 0.5, 2.0, 1.0]))
        peer.F, peer.H, peer.R = runge_kutta_of(F, 0.1), C, 0.1**2 * np.eye(2)
        peer.Q = process_covariance(L, drift=F)
        for k in range(record.num_samples):
            if k:
                peer.predict()
            peer.update(record.y[row, k])
            assert np.allclose(found.xhat[row, k], peer.x, rtol=0, atol=atol)
            assert np.allclose(found.P[row, k], peer.P, rtol=0, atol=atol)


def test_each_row_is_the_plant_with_its_constants():
    system = augmented(Satellite(), **SATELLITE)
    x = np.random.default_rng(0).standard_normal((4, 5, 7))
    f, h = system.f(0.0, x, np.zeros(0)), system.h(0.0, x, np.zeros(0))
    for at in np.ndindex(4, 5):
        a1, a3, bias, disturbance = x[at][3:]
        plant = Satellite(a1=a1, a3=a3)
        rate = plant.f(0.0, x[at][:3], np.zeros(0)) + np.array([0, disturbance, 0])
        assert np.allclose(f[at], [*rate, 0, 0, 0, 0], rtol=0, atol=1e-14)
        assert h[at] == pytest.approx(x[at][0] + bias)


@pytest.mark.parametrize("kind", [np.asarray, torch.tensor])
def test_jacobians_from_those_by_hand_are_those_of_all_equations(kind):
    system = augmented(Satellite(measure_x3=True), **SATELLITE)
    x = np.random.default_rng(0).standard_normal((4, 5, 7))
    t, u = np.zeros((4, 1)), np.zeros((4, 1, 0))
    for name in ("f_jacobian", "h_jacobian"):
        found = np.asarray(getattr(system, name)(*map(kind, (t, x, u))))
        exact = getattr(System, name)(system, t, x, u)
        assert np.allclose(found, exact, rtol=0, atol=1e-9)
        # What is not a difference is exact.
        columns = [0, 1, 2, 5, 6]
        assert np.array_equal(found[..., columns], exact[..., columns])


AUGMENTED = {
    "duffing": augmented(
        ReverseDuffing(), None, {"y1": Unknown(0.0, 0.3)}, {"x2": Unknown(0.1, 0.1)}
    ),
    "satellite": augmented(Satellite(), **SATELLITE),
    "undisturbed": augmented(Satellite(), {"a1": Unknown(0.5, 0.02)}),
    "driven": augmented(FeedThrough(), None, {"y2": Unknown(0.0, 0.1)}),
    "spring": augmented(Spring(), {"k": Unknown(4.0, 1.0), "gain": Unknown(1.0, 0.1)}),
}
AUGMENTED["twice"] = augmented(
    AUGMENTED["duffing"], None, None, {"x1": Unknown(0.0, 0.1), "bias_y1": Unknown(0.0, 0.01)}
)


@pytest.mark.parametrize("name", AUGMENTED)
def test_an_augmented_system_passes_the_checks(name):
    check_system(type(AUGMENTED[name]))


def test_twice_is_once_more():
    system = AUGMENTED["twice"]
    x = np.array([0.5, 0.6, 0.1, 0.2, 0.3, 0.4])
    assert system.h(0.0, x, np.zeros(0)) == pytest.approx([0.6])
    rate = [0.6**3 + 0.3, -0.5 + 0.2, 0.4, 0, 0, 0]
    assert np.allclose(system.f(0.0, x, np.zeros(0)), rate, rtol=0, atol=1e-15)


def test_the_rest_is_the_plants():
    system, plant = AUGMENTED["undisturbed"], Satellite()
    x = initial_states(system, system.setups["benchmark"], 50)
    state = x[:, :3]
    own = [Satellite(a1=a1).invariants(row) for row, a1 in zip(state, x[:, 3], strict=True)]
    assert np.allclose(system.invariants(x), own, rtol=1e-14)
    (other,) = system.indistinguishable(x)
    assert np.array_equal(other[:, :3], plant.indistinguishable(state)[0])
    assert np.array_equal(other[:, 3], x[:, 3])
    disturbed, some = AUGMENTED["satellite"], np.ones((2, 7))
    assert disturbed.invariants(some) is None
    assert disturbed.indistinguishable(some) == ()
    assert system.parameters == {"a2": -0.875, "a3": 2 / 3, "measure_x3": False}
    motor, t = InductionMotor(), np.linspace(0, 1, 7)
    loaded = augmented(motor, {"T_L": Unknown(10.0, 2.0)})
    assert np.array_equal(loaded.input(t), motor.input(t))
    assert loaded.breakpoints() == motor.breakpoints()
    states = np.random.default_rng(0).standard_normal((5, 6))
    assert np.array_equal(loaded.observable(states)[:, :5], motor.observable(states[:, :5]))
    assert loaded.observable(states)[:, 5].all()
    # What the plant leaves to System is so here, as others ask.
    assert type(system).input is System.input
    assert type(AUGMENTED["spring"]).admissible is System.admissible
    assert replace(system, measure_x3=True).output_names == ("y1", "y3")
    assert AUGMENTED["spring"].units["k"] == "1/s²"
    forced = augmented(Spring(), None, {"y": Unknown(0, 1)}, {"position": Unknown(0, 1)})
    assert forced.units["bias_y"] == "m"
    assert forced.units["disturbance_position"] == "m/s"
    rate = augmented(Spring(), disturbance={"velocity": Unknown(0, 1)})
    assert rate.units["disturbance_velocity"] == "m/s²"


def test_setups_have_the_constants_law_and_prior():
    system = AUGMENTED["spring"]
    assert system.scale == (1.0, 2.0, 1.0, 0.1)
    assert system.state_bound == (10.0, 20.0, 14.0, 2.0)
    x0 = initial_states(system, system.setups["benchmark"], 20_000)
    assert np.allclose(x0[:, 2:].mean(axis=0), [4.0, 1.0], rtol=0.02)
    assert np.allclose(x0[:, 2:].std(axis=0), [1.0, 0.1], rtol=0.02)
    mean, cov = prior_moments(system, system.setups["benchmark"])
    assert np.allclose(mean, [0, 0, 4, 1])
    assert np.allclose(cov, np.diag([3**2 / 12, 2**2 / 12, 1, 0.01]))
    other, setup = type(system).configured("stiff")
    mean, cov = prior_moments(other, setup)
    assert np.allclose(mean, [0.8, 0, 9, 1])  # the setup says k
    assert np.allclose(setup.x0_high, [1, 0, 9 + 3**0.5, 1 + 0.1 * 3**0.5])
    expected = np.diag([1, 2, 1, 0.01])
    expected[0, 1] = expected[1, 0] = 0.5
    assert np.allclose(cov, expected)
    assert other.parameters == {"damping": 0.3}
    poor = AUGMENTED["undisturbed"].setups["benchmark"].poor_prior
    assert poor is not None
    assert np.allclose(poor.xhat0, [1, 1, 2, 0.5])
    assert np.allclose(poor.P0, np.diag(np.square([1.5, 1.5, 1.0, 0.02])))


def test_equal_arguments_give_equal_systems_also_through_pickle():
    system = augmented(Satellite(), **SATELLITE)
    again = augmented(Satellite(), **SATELLITE)
    assert again == system
    assert type(again).__name__ == "Satellite_a1_a3_bias_y1_disturbance_x2"
    changed = replace(system, a2=-0.8)
    assert pickle.loads(pickle.dumps(changed)) == changed != system
    assert copy.deepcopy(changed) == changed


def test_scores_depend_on_what_is_said_of_the_constants():
    hashes = [
        game_hash(EpisodeSource(type(augmented(Spring(), {"k": Unknown(4.0, std)}))))
        for std in (1.0, 1.0, 0.5)
    ]
    assert hashes[0] == hashes[1] != hashes[2]


def test_it_can_be_traced():
    equations = trace(AUGMENTED["spring"])
    position, velocity, k, gain = equations.x
    damping = equations.parameters["damping"]
    rate = -k * sympy.sin(position) - damping * velocity
    assert sympy.simplify(equations.f[1] - rate) == 0
    assert equations.h[0] == gain * position


def test_an_unknown_stiffness_is_found():
    system = augmented(Spring(), {"k": Unknown(4.0, 0.8)})
    source = EpisodeSource(type(system))
    batch = source.play(source.draw(source.streams(range(40))))
    found = EKF(system).run(source.record(batch))
    error = abs(found.xhat[:, -1, 2] - batch.x[-1, :, 2])
    std = np.sqrt(found.P[:, -1, 2, 2])
    assert (error <= 3 * std).mean() >= 0.95
    assert np.median(std) < 0.1 * 0.8


@dataclass(frozen=True)
class Battery(System):
    """A cell with one resistor and capacitor; its open-circuit voltage is a table of its state of
    charge."""

    R0: float = 0.02
    capacity: float = 2.9

    state_names = ("SoC", "V1")
    output_names = ("V",)
    input_names = ("i",)
    scale = (0.3, 0.05)
    setups = {
        "benchmark": Setup(
            (0.5, 0),
            (0.9, 0),
            duration=4800,
            dt=1,
            noise_std=5e-3,
            xhat0=(0.7, 0.0),
            P0=((0.2**2, 0), (0, 0.01**2)),
        )
    }
    voltages: ClassVar = (3.00, 3.40, 3.50, 3.57, 3.62, 3.68, 3.76, 3.86, 3.96, 4.07, 4.19)

    charges: ClassVar = tuple(k / 10 for k in range(11))

    def ocv(self, soc):
        return table(soc, self.charges, self.voltages, "monotone")

    def f(self, t, x, u):
        i = u[..., 0]
        return stack(x, -i / (3600 * self.capacity), -x[..., 1] / 30 + i / 1500)

    def h(self, t, x, u):
        return stack(x, self.ocv(x[..., 0]) - x[..., 1] - self.R0 * u[..., 0])

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0.0, 0.0], [0.0, -1 / 30]])

    def h_jacobian(self, t, x, u):
        slope = (self.ocv(x[..., 0] + 1e-6) - self.ocv(x[..., 0] - 1e-6)) / 2e-6
        return matrix(x, [[slope, -1.0]])


def battery_records(rows, R0):
    """States of charge and noisy records of drives, by closed forms. The current changes every 20 s
    and is held between samples."""
    rng, plant = np.random.default_rng(0), Battery()
    t = plant.setups["benchmark"].times
    i = rng.uniform(-3, 6, (rows, len(t) // 20 + 1)).repeat(20, axis=1)[:, : len(t)]
    charge = 3600 * plant.capacity
    i += (0.7 * charge / t[-1] - i[:, :-1].mean(axis=1))[:, None]  # from 0.9 to 0.2
    used = np.cumsum(i[:, :-1], axis=1)
    soc = 0.9 - np.concatenate([np.zeros((rows, 1)), used], axis=1) / charge
    # V1 of a current that is constant over 1 s
    v1, decay = np.zeros(i.shape), np.exp(-1 / 30)
    for k in range(1, len(t)):
        v1[:, k] = decay * v1[:, k - 1] + 0.02 * (1 - decay) * i[:, k - 1]
    y = plant.ocv(soc) - v1 - R0[:, None] * i + 5e-3 * rng.standard_normal(i.shape)
    return t, soc, y[..., None], (i + 0.02 * rng.standard_normal(i.shape))[..., None]


def test_charge_resistance_and_capacity_of_a_battery_are_found():
    R0 = np.random.default_rng(1).normal(0.03, 0.01, 10)
    system = augmented(
        Battery(measured_input=True), {"R0": Unknown(0.03, 0.01), "capacity": Unknown(3.1, 0.3)}
    )
    t, soc, y, u = battery_records(10, R0)
    prior = Prior.of(system, system.setups["benchmark"], 10)
    found = EKF(system).run(Record(t, y, u, prior))
    std = np.sqrt(np.diagonal(found.P, axis1=2, axis2=3))
    error = found.xhat[..., 0] - soc
    assert (abs(error) <= 3 * std[..., 0]).mean() >= 0.99
    assert np.sqrt((error[:, t >= 300] ** 2).mean(axis=1)).max() <= 0.01
    for column, true, prior_std in ((2, R0, 0.01), (3, 2.9, 0.3)):
        off = abs(found.xhat[:, -1, column] - true)
        assert (off <= 3 * std[:, -1, column]).all()
        assert (std[:, -1, column] < 0.1 * prior_std).all()


@dataclass(frozen=True)
class Odd(Spring):
    """What cannot be augmented: parameters of the input, the breakpoints and of whole arrays, and
    one that is no number."""

    amplitude: float = 1.0
    jump: float = 0.5
    whole: float = 1.0
    kind: str = "soft"

    def f(self, t, x, u):
        return super().f(t, x, u) * self.whole

    def input(self, t):
        return self.amplitude * t[..., None]

    def breakpoints(self):
        return (self.jump,)

    input_names = ("u",)


ONE = Unknown(1.0, 0.1)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({}, "nothing of Odd is unknown; give parameters, output_bias, disturbance or rates"),
        (
            {"parameters": {"m": ONE}},
            "parameters: unknown parameter 'm' of Odd; it has k, damping, gain, amplitude, jump, ",
        ),
        ({"output_bias": {"z": ONE}}, "output_bias: unknown output 'z' of Odd; it has y"),
        (
            {"disturbance": {"k": ONE}},
            "disturbance: unknown state 'k' of Odd; it has position, velocity",
        ),
        ({"parameters": {"k": 3.0}}, r"parameters\['k'\]=3.0; expected Unknown\(mean, std\)"),
        ({"parameters": {"kind": ONE}}, "parameter kind='soft' of Odd; expected a number"),
        ({"parameters": {"amplitude": ONE}}, "parameter amplitude of Odd acts on its input"),
        ({"parameters": {"jump": ONE}}, "parameter jump of Odd acts on its breakpoints"),
        (
            {"parameters": {"whole": ONE}},
            r"Odd.f raises ValueError: .* expected \(5, 3\), from self.k \* x\[..., 0\]",
        ),
    ],
)
def test_what_cannot_be_augmented_is_refused_in_one_line(given, says):
    with pytest.raises(ValueError, match=says) as raised:
        augmented(Odd(), **given)
    assert "\n" not in str(raised.value)


@dataclass(frozen=True)
class Taken(Spring):
    """A parameter has the name of a bias."""

    bias_y: float = 0.0


def test_a_name_is_given_once():
    for parameters in (None, {"bias_y": ONE}):
        with pytest.raises(ValueError, match="Taken has 'bias_y' already; the new state"):
            augmented(Taken(), parameters, {"y": ONE})
    once = augmented(Spring(), output_bias={"y": ONE})
    with pytest.raises(ValueError, match="Spring_bias_y has 'bias_y' already; the new state"):
        augmented(once, output_bias={"y": ONE})


@pytest.mark.parametrize(
    ("mean", "std", "says"),
    [
        (1.0, 0.0, "std=0.0 of an Unknown; expected a number above 0"),
        (1.0, -1, "std=-1 of an Unknown; expected a number above 0"),
        (np.nan, 1, "mean=nan of an Unknown; expected a number"),
        ("1", 1, "mean='1' of an Unknown; expected a number"),
        (1.0, np.inf, "std=inf of an Unknown; expected a number above 0"),
    ],
)
def test_an_unknown_has_a_mean_and_a_standard_deviation(mean, std, says):
    with pytest.raises(ValueError, match=says):
        Unknown(mean, std)
