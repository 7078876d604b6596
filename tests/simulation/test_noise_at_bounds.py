"""Process noise at the bounds of states: the truth and ensembles stay within them alike."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from compiled_plants import by_numpy, compiled
from fake_compilers import needs_compiler

from pinnobs_gym.simulation.bounds import absorbed, box
from pinnobs_gym.simulation.checks import SYSTEM_CHECKS
from pinnobs_gym.simulation.conditions.plant import OtherRates
from pinnobs_gym.simulation.model import noisy_model_step
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.simulation.truth import disturbed_truth, noise_shape


@dataclass(frozen=True)
class Wander(System):
    """A quantity of at least zero that only noise moves."""

    drift: float = 0.0

    state_names = ("q",)
    output_names = ("y",)
    scale = (1.0,)
    state_low = (0.0,)
    model_step = 0.05
    setups = {
        "benchmark": Setup((0.0,), (1.0,), duration=4, dt=0.1, noise_std=0.1, process_noise=1.0)
    }

    def f(self, t, x, u):
        return self.drift + 0 * x

    def h(self, t, x, u):
        return x


@dataclass(frozen=True)
class Stiff(Wander):
    stiff = True


@dataclass(frozen=True)
class Own(Wander):
    def flow(self, t0, t1, x, u):
        return x + 0 * (t1 - t0)


@dataclass(frozen=True)
class WanderMap(Wander):
    discrete = True
    setups = {"benchmark": replace(Wander.setups["benchmark"], duration=40, dt=2)}

    def f(self, t, x, u):
        return x + 0


KINDS = [Wander, Stiff, Own, WanderMap]


def path(system, plant=None, batch=50):
    setup = system.setups["benchmark"]
    noise = system.noise()
    plant = system if plant is None else plant
    parts, each, m = noise_shape(system, noise, setup.dt, 0.05)
    draws = np.random.default_rng(0).normal(size=(setup.num_steps, parts, each, batch, m))
    return disturbed_truth(plant, noise, np.full((batch, 1), 0.5), setup.times, draws, 0.05), draws


def ensemble(system, points=20, batch=3):
    setup, rng = system.setups["benchmark"], np.random.default_rng(1)
    start = np.full((points, batch, 1), 0.01)
    return noisy_model_step(
        *(system, system.noise(), 0.0, setup.dt, start, None, None),
        lambda size: rng.normal(size=(points, 1, size)),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_truth_and_ensembles_stay_within_and_reach_the_bound(kind):
    x, _ = path(kind())
    assert x.min() == 0.0
    assert (x == 0.0).mean() < 0.5
    members = ensemble(kind())
    assert members.min() == 0.0
    assert members.max() > 0.01
    SYSTEM_CHECKS["bounds"](kind)


def test_a_walk_at_its_bound_is_that_of_lindley():
    """Steps of a walk that is absorbed at zero are its sums less their running minimum (Lindley
    1952, "The theory of queues with a single server")."""
    x, draws = path(Wander())
    steps = draws[:, :, 0, :, 0] * np.sqrt(0.05)
    sums = 0.5 + np.cumsum(steps.reshape(-1, 50), axis=0)
    lowest = np.minimum(np.minimum.accumulate(sums, axis=0), 0.0)
    np.testing.assert_allclose(x[1:, :, 0], (sums - lowest)[1::2], rtol=0, atol=1e-12)


def test_a_plant_with_other_rates_has_the_bounds_of_its_own():
    assert path(Wander(), OtherRates(Wander(), np.ones((50, 1))))[0].min() == 0.0


@needs_compiler
@pytest.mark.parametrize("kind", [Wander, WanderMap])
def test_compiled_code_agrees(kind):
    for template, call in (("model", ensemble), ("truth", lambda system: path(system)[0])):
        if kind is Wander or template == "model":
            system = kind()
            reference = by_numpy(lambda: call(system))  # noqa: B023
            found = compiled(template, system, lambda: call(system))  # noqa: B023
            np.testing.assert_allclose(found, reference, rtol=0, atol=1e-13)
            assert found.min() == 0.0


def test_states_that_are_not_finite_are_not_hidden():
    x = np.array([[-np.inf], [np.nan], [-1.0], [2.0]])
    found = absorbed(x, box((0.0,), None, 1))
    np.testing.assert_array_equal(found, [[-np.inf], [np.nan], [0.0], [2.0]])
