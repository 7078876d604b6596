"""Measured inputs between samples: held from the last one, or on straight lines."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from benchmarks.plants.motion import Reactor, reactor_error, reactor_run
from linear import FeedThrough, record_of

from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.augmented import augmented
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.model import model_step, model_step_moments
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, matrix, stack
from pinnobs_gym.systems.induction_motor import InductionMotor
from trainers.pinn_obs.points import points_of


@dataclass(frozen=True)
class Cart(System):
    """A cart with its acceleration as the input, and its position measured."""

    state_names = ("p", "v")
    output_names = ("p",)
    input_names = ("a",)
    scale = (1.0, 1.0)
    setups: ClassVar = {"benchmark": Setup((-1, -1), (1, 1), duration=10, dt=0.1, noise_std=0.02)}

    def f(self, t, x, u):
        return stack(x, x[..., 1], u[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, ((0, 1), (0, 0)))

    def h_jacobian(self, t, x, u):
        return matrix(x, ((1, 0),))


@dataclass(frozen=True)
class Joined(Cart):
    """The same with an input that is on straight lines."""

    input_hold = "linear"


def held_record():
    """States (400, 2) of a cart whose acceleration is held over 2 s, in closed form, and the
    record."""
    rng, d, count = np.random.default_rng(0), 0.5, 400
    u = np.repeat(rng.choice([-1.0, 1.0], count // 4), 4)
    x = [np.zeros(2)]
    for a in u[:-1]:
        p, v = x[-1]
        x.append(np.array([p + d * v + d * d / 2 * a, v + d * a]))
    path = np.array(x)
    y = path[:, :1] + 0.02 * rng.standard_normal((count, 1))
    prior = Prior(np.zeros((1, 2)), np.diag([0.01, 0.01])[None])
    return path, Record(np.arange(count) * d, y[None], u[None, :, None], prior)


def test_a_held_input_is_right_and_its_standard_deviation_with_it():
    path, record = held_record()
    found = EKF(Cart(measured_input=True)).run(record)
    error = found.xhat[0, 50:, 1] - path[50:, 1]
    std = np.sqrt(found.P[0, 50:, 1, 1])
    assert np.sqrt(np.mean(error**2)) < 0.003
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.5
    joined = EKF(Joined(measured_input=True)).run(record)
    assert np.sqrt(np.mean((joined.xhat[0, 50:, 1] - path[50:, 1]) ** 2)) > 0.2


def test_inputs_between_samples_in_closed_form():
    x0 = np.array([[0.3, -0.2], [1.0, 2.0]])
    u0, u1 = np.array([[1.0], [-2.0]]), np.array([[3.0], [0.5]])
    d = 0.3
    for cls, slope in ((Cart, 0.0), (Joined, 1.0)):
        system = cls(measured_input=True)
        a, rise = u0[:, 0], slope * (u1 - u0)[:, 0]
        p = x0[:, 0] + d * x0[:, 1] + d * d / 2 * a + d * d / 6 * rise
        v = x0[:, 1] + d * a + d / 2 * rise
        expected = np.stack([p, v], axis=-1)
        for x in (
            model_step(system, 2.0, 2.0 + d, x0, u0, u1),
            model_step_moments(system, system.noise(), 2.0, 2.0 + d, x0, u0, u1)[0],
        ):
            np.testing.assert_allclose(x, expected, rtol=0, atol=1e-12)


def test_an_augmented_system_has_the_hold_of_its_plant():
    for cls in (Cart, Joined):
        system = augmented(cls(measured_input=True), output_bias={"p": Unknown(0.0, 1.0)})
        assert system.input_hold == cls.input_hold


def test_the_motors_inputs_are_joined_and_the_page_says_so():
    assert InductionMotor.input_hold == "linear"
    assert "the inputs of a log are joined by straight lines" in page(InductionMotor, "x")
    assert "the inputs of a log are held from the last sample on" in page(Cart, "x")


def test_an_empty_input_keeps_its_last_value(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("t,y1,u1\n0,1,0.5\n1,2,\n2,,nan\n3,1,-1\n4,1,\n")
    system = Cart()
    prior = Prior.of(system, system.setups["benchmark"], 1)
    log = read_log(path, system, prior)
    assert log.system.measured_input
    assert log.record.u[0, :, 0].tolist() == [0.5, 0.5, 0.5, -1.0, -1.0]
    path.write_text("t,y1,u1\n0,1,\n1,2,3\n")
    with pytest.raises(ValueError, match="line 2: u1 is empty; expected a number in the first row"):
        read_log(path, system, prior)


def test_the_reactors_model_follows_held_inputs():
    path, record = reactor_run(0)
    assert reactor_error(path, record) < 5e-6
    found = EKF(Reactor(measured_input=True)).run(record)
    assert abs(found.xhat[0, 10:, 0] - path[10:, 0]).max() <= 5e-4


@pytest.mark.parametrize("cls", [Cart, Joined])
def test_points_of_a_record_have_the_inputs_of_the_model(cls):
    _, record = held_record()
    system = cls(measured_input=True)
    points, _ = points_of(system, record.first_samples(60), 1000)
    expected = np.interp(points.t, record.t, record.u[0, :, 0])
    if cls is Cart:
        expected = record.u[0, np.searchsorted(record.t, points.t, side="right") - 1, 0]
    np.testing.assert_allclose(points.u[:, 0], expected, rtol=0, atol=1e-12)


def test_inputs_that_the_model_would_not_use_are_refused():
    """Without measured inputs, the model has those of `System.input`."""
    record = record_of(EpisodeSource(FeedThrough), 2)
    EKF(FeedThrough()).run(record)
    other = replace(record, u=record.u + 0.5)
    with pytest.raises(ValueError, match=r"input u1=.* is not that of FeedThrough\.input") as error:
        EKF(FeedThrough()).run(other)
    assert "\n" not in str(error.value)
    EKF(FeedThrough(measured_input=True)).run(other)
