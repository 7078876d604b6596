"""The observability of plants against closed forms."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from angles import Compass

from pinnobs_gym.simulation.observability import observability
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.systems import SYSTEMS

DT, SAMPLES, NOISE = 0.1, 20, 0.3


@dataclass(frozen=True)
class Cart(System):
    """A cart of constant velocity whose position is measured, and a constant nothing depends on."""

    state_names = ("q", "v", "colour")
    output_names = ("y",)
    scale = (2.0, 0.5, 7.0)
    setups = {
        "benchmark": Setup(
            x0_low=(-1, -2, 3), x0_high=(1, 2, 4), duration=DT * SAMPLES, dt=DT, noise_std=NOISE
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], 0.0, 0.0)

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0, 1, 0], [0, 0, 0], [0, 0, 0]])

    def h_jacobian(self, t, x, u):
        return matrix(x, [[1, 0, 0]])


class Sum(Cart):
    """Velocity and colour move the cart together."""

    def f(self, t, x, u):
        return stack(x, x[..., 1] + x[..., 2], 0.0, 0.0)

    def f_jacobian(self, t, x, u):
        return matrix(x, [[0, 1, 1], [0, 0, 0], [0, 0, 0]])


class Steps(Cart):
    """The same cart as a map with a step of one."""

    discrete = True
    setups = {"benchmark": replace(Cart.setups["benchmark"], dt=1, duration=SAMPLES)}

    def f(self, t, x, u):
        return stack(x, x[..., 0] + x[..., 1], x[..., 1], x[..., 2])

    def f_jacobian(self, t, x, u):
        return matrix(x, [[1, 1, 0], [0, 1, 0], [0, 0, 1]])


class Wheel(Cart):
    """The colour turns the cart's input into motion."""

    input_names = ("u",)

    def f(self, t, x, u):
        return stack(x, x[..., 1] + x[..., 2] * u[..., 0], 0.0, 0.0)

    f_jacobian = System.f_jacobian


class Driven(Wheel):
    def draw_input(self, rng, times):
        return rng.standard_normal((len(times), 1))


class Stiff(Sum):
    stiff = True


def of(system):
    return observability(system, system.setups["benchmark"])


def gramian(t):
    """That of position and velocity, in their units."""
    rows = np.stack([np.ones_like(t), t], axis=1)
    return rows.T @ rows / NOISE**2


@pytest.mark.parametrize(("system", "dt"), [(Cart(), DT), (Steps(), 1.0)])
def test_gramian_and_what_is_left_are_those_in_closed_form(system, dt):
    """A known constant: the median and all trajectories of a linear plant are the same."""
    found, G = of(system), gramian(dt * np.arange(SAMPLES))
    variance = np.array([4 / 12, 16 / 12])
    left = np.diag(np.linalg.inv(np.diag(1 / variance) + G)) / variance
    np.testing.assert_allclose(found.left[:, :2] ** 2, np.tile(left, (16, 1)), rtol=1e-9)
    np.testing.assert_allclose(found.prior_std**2, [*variance, 1 / 12], rtol=1e-12)


def test_the_condition_number_is_that_of_the_scaled_gramian():
    known = replace_names(Cart, 2)
    scale = np.array(Cart.scale[:2])
    scaled = gramian(DT * np.arange(SAMPLES)) * scale * scale[:, None]
    np.testing.assert_allclose(of(known()).condition, np.linalg.cond(scaled), rtol=1e-9)


def replace_names(cls, nx):
    """The cart without its colour."""

    @dataclass(frozen=True)
    class Bare(System):
        state_names, output_names, scale = cls.state_names[:nx], cls.output_names, cls.scale[:nx]
        setups = {
            "benchmark": replace(cls.setups["benchmark"], x0_low=(-1.0, -2.0), x0_high=(1.0, 2.0))
        }

        def f(self, t, x, u):
            return stack(x, x[..., 1], 0.0)

        def h(self, t, x, u):
            return x[..., :1]

    return Bare


@pytest.mark.parametrize("cls", [Cart, Steps, Wheel])
def test_a_constant_that_acts_on_nothing_is_named(cls):
    found = of(cls())
    assert (found.rank == 2).all()
    assert (found.unseen, found.mixed) == (("colour",), ())
    assert np.isinf(found.condition).all()
    np.testing.assert_allclose(found.left[:, 2], 1.0, rtol=1e-12)


@pytest.mark.parametrize("cls", [Sum, Stiff])
def test_two_states_that_are_seen_as_a_sum_are_named(cls):
    found = of(cls())
    assert (found.rank == 2).all()
    assert (found.unseen, found.mixed) == ((), ("v", "colour"))


def test_drawn_inputs_tell_what_no_input_tells():
    found = of(Driven())
    assert (found.rank == 3).all()
    assert not (found.unseen + found.mixed)
    assert (found.left[:, 2] < 1).all()


@pytest.mark.parametrize("cls", [*SYSTEMS.classes().values(), Compass])
def test_all_states_of_these_plants_are_seen(cls):
    system, setup = cls.configured(duration=20 * cls.setups["benchmark"].dt)
    found = observability(system, setup)
    assert (found.rank == system.nx).all()
    assert not (found.unseen + found.mixed)
    assert np.isfinite(found.condition).all()
    assert (found.left < 1).all()


def test_outputs_without_noise_have_their_scale():
    """The scale of the position is 2."""
    setup = replace(Cart.setups["benchmark"], noise_std=0.0)
    told = observability(Cart(), replace(setup, noise_std=2.0))
    np.testing.assert_allclose(observability(Cart(), setup).left, told.left, rtol=1e-12)


def test_growth_hides_nothing():
    """ẋ₁ = 3x₁, x₂ constant and y = x₁ + x₂, over a time in which x₁ grows by e⁶⁰."""

    @dataclass(frozen=True)
    class Growing(System):
        state_names, output_names, scale = ("grows", "stays"), ("y",), (1.0, 1.0)
        setups = {"benchmark": Setup((0, 0), (1, 1), duration=20, dt=0.05, noise_std=0.1)}

        def f(self, t, x, u):
            return stack(x, 3 * x[..., 0], 0.0)

        def h(self, t, x, u):
            return x[..., :1] + x[..., 1:]

        def f_jacobian(self, t, x, u):
            return matrix(x, [[3, 0], [0, 0]])

        def h_jacobian(self, t, x, u):
            return matrix(x, [[1, 1]])

    assert (of(Growing()).rank == 2).all()


def test_a_fixed_initial_state_is_varied_by_the_prior():
    """At rest, a pendulum hanging from a spring of unknown strength would tell nothing of it."""

    @dataclass(frozen=True)
    class Spring(System):
        state_names, output_names, scale = ("q", "v", "k"), ("y",), (1.0, 1.0, 1.0)
        setups = {
            "benchmark": Setup(
                (0, 0, 1),
                (0, 0, 1),
                xhat0=(0, 0, 1),
                P0=independent(1, 1, 0.3),
                duration=2,
                dt=0.1,
                noise_std=0.1,
            )
        }

        def f(self, t, x, u):
            return stack(x, x[..., 1], -x[..., 2] * x[..., 0], 0.0)

        def h(self, t, x, u):
            return x[..., :1]

    assert of(Spring()).unseen == ()
    assert (of(Spring()).rank == 3).all()
