"""Steps of the model end at the times at which f or the input jumps."""

from dataclasses import dataclass

import numpy as np
import pytest
from array_api_compat import array_namespace

from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.model import model_step, model_step_jacobian
from pinnobs_gym.simulation.system import Setup, System, stack

JUMPS = (3.71, 7.13)


@dataclass(frozen=True)
class Tank(System):
    """A tank whose inflow jumps twice, and one that it drains into."""

    state_names = ("a", "b")
    output_names = ("y",)
    scale = (1.0, 1.0)
    model_step = 0.0625
    setups = {"benchmark": Setup((-1, -1), (1, 1), duration=12, dt=0.5, noise_std=0.01)}

    def f(self, t, x, u):
        inflow = 5.0 * (t >= JUMPS[0]) - 8.0 * (t >= JUMPS[1])
        return stack(x, -x[..., 0] + inflow, x[..., 0] - 0.2 * x[..., 1])

    def h(self, t, x, u):
        return x[..., 1:]

    def breakpoints(self):
        return JUMPS


def level(t, a):
    """The first tank, in closed form, from a at time 0."""
    rise = sum(
        size * np.where(t > b, 1 - np.exp(-np.maximum(t - b, 0.0)), 0.0)
        for size, b in zip((5.0, -8.0), JUMPS, strict=True)
    )
    return a * np.exp(-t) + rise


@pytest.mark.parametrize("end", [3.5, 3.71, 4.0, 7.13, 12.0])
def test_a_step_over_jumps_is_the_closed_form(end):
    found = model_step(Tank(), 0.0, end, np.array([[0.4, 0.1]]))
    assert found[0, 0] == pytest.approx(level(end, 0.4), abs=1e-5)


def test_a_step_from_a_jump_has_what_follows_it():
    found = model_step(Tank(), JUMPS[0], 4.0, np.array([[0.4, 0.1]]))
    decay = np.exp(-(4.0 - JUMPS[0]))
    assert found[0, 0] == pytest.approx(0.4 * decay + 5 * (1 - decay), abs=1e-6)


def test_rows_with_times_of_their_own():
    t0, t1 = np.array([0.0, 3.5, 3.71, 7.0]), np.array([1.0, 8.0, 4.0, 7.13])
    x = np.tile([0.4, 0.1], (4, 1))
    found, F = model_step_jacobian(Tank(), t0, t1, x)
    for i in range(4):
        one, flow = model_step_jacobian(Tank(), t0[i], t1[i], x[i : i + 1])
        np.testing.assert_allclose(found[i], one[0], atol=1e-5)
        np.testing.assert_allclose(F[i], flow[0], atol=1e-5)
        assert F[i, 0, 0] == pytest.approx(np.exp(-(t1[i] - t0[i])), abs=1e-5)


def test_a_plant_that_jumps_conforms():
    check_system(Tank)


@dataclass(frozen=True)
class Driven(Tank):
    """Its inflow is a measured input, joined by straight lines."""

    input_names = ("inflow",)
    input_hold = "linear"

    def f(self, t, x, u):
        xp = array_namespace(x)
        return xp.stack([u[..., 0] + 0.0 * x[..., 0], 0.0 * x[..., 1]], axis=-1)


def test_measured_inputs_stay_those_of_the_whole_interval():
    system = Driven(measured_input=True)
    u0, u1 = np.array([[1.0]]), np.array([[3.0]])
    found = model_step(system, 3.0, 4.0, np.zeros((1, 2)), u0, u1)
    assert found[0, 0] == pytest.approx(2.0, abs=1e-12)  # the mean of both
