"""Steps of a stiff plant end at the times at which f or the input jumps."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest
from array_api_compat import array_namespace

from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.model import model_step, model_step_moments, noisy_model_step
from pinnobs_gym.simulation.system import Setup, System, matrix, stack

JUMPS = ((0.71, 5.0), (0.712, -5.0), (2.0, 4.0))
"""Times in s, and the size of the input's jump at each: a pulse of 2 ms, and a step."""
SIGMA = 0.3
TOLERANCE = 1e-7
"""A few steps' worth of that of the solver, 1e-8."""


@dataclass(frozen=True)
class Pulsed(System):
    """ẋ = −rate·(x − u) and v̇ = −v + u, with an input that jumps."""

    rate: float = 1000.0

    state_names = ("x", "v")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    stiff = True
    setups: ClassVar = {
        "benchmark": Setup((-1, -1), (1, 1), duration=4, dt=0.5, noise_std=0.1, process_noise=SIGMA)
    }

    def f(self, t, x, u):
        return stack(x, -self.rate * (x[..., 0] - u[..., 0]), u[..., 0] - x[..., 1])

    def h(self, t, x, u):
        return x.sum(-1)[..., None]

    def f_jacobian(self, t, x, u):
        return matrix(x, ((-self.rate, 0), (0, -1)))

    def input(self, t):
        xp = array_namespace(t)
        return sum(size * xp.where(t >= b, xp.ones_like(t), xp.zeros_like(t)) for b, size in JUMPS)[
            ..., None
        ]

    def breakpoints(self):
        return tuple(b for b, _ in JUMPS)


def exact(rate, t0, t1, x0):
    """The states (2,) at t1 from x0 at t0, in closed form."""
    a = np.array([rate, 1.0])
    x = x0 * np.exp(-a * (t1 - t0))
    for b, size in JUMPS:
        if t1 > b:
            x = x + size * (1 - np.exp(-a * (t1 - max(b, t0))))
    return x


@pytest.mark.parametrize("rate", [1.0, 30.0, 1e4])
def test_steps_over_jumps_are_the_closed_form(rate):
    x0 = np.array([0.4, -0.2])
    for t0, t1 in ((0.0, 0.7), (0.0, 0.71), (0.0, 4.0), (0.71, 0.711), (0.712, 2.0), (2.0, 2.5)):
        found = model_step(Pulsed(rate), t0, t1, x0[None])
        np.testing.assert_allclose(found[0], exact(rate, t0, t1, x0), rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("rate", [1.0, 1e4])
def test_rows_with_times_of_their_own_have_the_moments_in_closed_form(rate):
    system = Pulsed(rate)
    t0, t1 = np.array([0.0, 0.5, 0.711, 0.71, 1.9]), np.array([0.7, 4.0, 2.0, 0.712, 2.1])
    x0 = np.random.default_rng(0).standard_normal((5, 2))
    x, F, Q = model_step_moments(system, system.noise(), t0, t1, x0)
    a = np.array([rate, 1.0])
    for i in range(5):
        alone = model_step_moments(system, system.noise(), t0[i], t1[i], x0[i : i + 1])
        assert np.array_equal(x[i], alone[0][0])
        assert np.array_equal(F[..., i], alone[1][..., 0])
        assert np.array_equal(Q[..., i], alone[2][..., 0])
        decay = np.exp(-a * (t1[i] - t0[i]))
        variance = SIGMA**2 * (1 - decay**2) / (2 * a)
        np.testing.assert_allclose(x[i], exact(rate, t0[i], t1[i], x0[i]), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(F[..., i], np.diag(decay), rtol=0, atol=TOLERANCE)
        np.testing.assert_allclose(Q[..., i], np.diag(variance), rtol=1e-6, atol=1e-12)


def test_noisy_states_have_the_mean_of_the_closed_form():
    system, x0 = Pulsed(), np.array([0.4, -0.2])
    rng = np.random.default_rng(1)
    draws = rng.standard_normal((50, 1, 2))
    draws = np.concatenate([draws, -draws])
    points = np.broadcast_to(x0, (100, 1, 2))
    end = noisy_model_step(system, system.noise(), 0.0, 3.0, points, None, None, lambda _: draws)
    mean = end.mean(axis=(0, 1))
    np.testing.assert_allclose(mean, exact(1000.0, 0.0, 3.0, x0), rtol=0, atol=TOLERANCE)


def test_a_stiff_plant_that_jumps_conforms():
    check_system(Pulsed)


@dataclass(frozen=True)
class Measured(Pulsed):
    """Its input is measured, and joined by straight lines."""

    input_hold = "linear"

    def breakpoints(self):
        return ()


def test_moments_with_a_measured_input_are_those_of_a_straight_line():
    system, T = Measured(50.0, measured_input=True), 0.8
    rng = np.random.default_rng(0)
    x0, u0, u1 = (rng.standard_normal((3, n)) for n in (2, 1, 1))
    x, F, _ = model_step_moments(system, system.noise(), 1.0, 1.0 + T, x0, u0, u1)
    a = np.array([50.0, 1.0])
    decay = np.exp(-a * T)
    expected = x0 * decay + u0 * (1 - decay) + (u1 - u0) / T * (T - (1 - decay) / a)
    np.testing.assert_allclose(x, expected, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(F[..., 1], np.diag(decay), rtol=0, atol=TOLERANCE)
