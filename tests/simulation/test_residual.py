"""Differences of angles, what systems say of them, and the checks of it."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from angles import TURN, Compass, Unwrapped

from pinnobs_gym.simulation.augmented import augmented
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.checks import SYSTEM_CHECKS, check_system
from pinnobs_gym.simulation.conditions.plant import OtherRates
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.residual import nearest, residual
from pinnobs_gym.simulation.system import System, output_scale, stack
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@pytest.mark.parametrize("period", [TURN, 360.0, 1.0])
def test_a_residual_is_the_remainder_of_least_size(period):
    """Of the C library (IEEE 754), which is exact."""
    rng = np.random.default_rng(0)
    a, b = 5 * period * rng.standard_normal((2, 200, 2))
    found = residual(a, b, (period, None))
    expected = [math.remainder(d, period) for d in (a - b)[:, 0]]
    np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-14 * period)
    np.testing.assert_array_equal(found[:, 1], (a - b)[:, 1])


def test_the_ends_of_a_period():
    """Half a period counts as minus half of one; what is within is unchanged to the last bit."""
    ends = np.array([[-0.5], [0.5], [1.5], [-1.5], [np.nextafter(0.5, 0)], [-1e-300], [0.1]])
    expected = [[-0.5], [-0.5], [-0.5], [-0.5], [np.nextafter(0.5, 0)], [-1e-300], [0.1]]
    np.testing.assert_array_equal(residual(ends, 0.0, (1.0,)), expected)


def test_residuals_of_huge_and_other_values():
    values = np.array([[1e300, np.nan, np.inf]]).T
    found = residual(values, 0.0, (TURN,))[:, 0]
    assert abs(found[0]) <= TURN / 2
    assert np.isnan(found[1:]).all()


def test_torch_has_the_same_residual_and_its_derivative_is_one():
    rng = np.random.default_rng(1)
    a, b = 20 * rng.standard_normal((2, 50, 3))
    periods = (TURN, None, 1.0)
    given = torch.tensor(a, requires_grad=True)
    found = residual(given, torch.tensor(b), periods)
    np.testing.assert_array_equal(found.detach().numpy(), residual(a, b, periods))
    found.sum().backward()
    np.testing.assert_array_equal(given.grad.numpy(), np.ones_like(a))


def test_nearest_values_differ_by_whole_periods():
    rng = np.random.default_rng(2)
    values, reference = 20 * rng.standard_normal((2, 6, 50, 2))
    found = nearest(values, reference[0], (TURN, None))
    turns = (values - found)[..., 0] / TURN
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert (abs(found - reference[0])[..., 0] <= TURN / 2 * (1 + 1e-12)).all()
    np.testing.assert_array_equal(found[..., 1], values[..., 1])
    near = abs((values - reference[0])[..., 0]) < TURN / 2
    np.testing.assert_array_equal(found[..., 0][near], values[..., 0][near])


def test_a_system_without_angles_has_plain_differences():
    a, b = np.random.default_rng(3).standard_normal((2, 4, 2))
    system = ReverseDuffing()
    np.testing.assert_array_equal(system.state_residual(a, b), a - b)
    np.testing.assert_array_equal(system.output_residual(a[:, :1], b[:, :1]), (a - b)[:, :1])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("output_period", (TURN, TURN)),
        ("output_period", TURN),
        ("output_period", (0.0,)),
        ("state_period", (TURN,)),
        ("state_period", (-1.0, None)),
        ("state_period", (np.inf, None)),
        ("state_period", ("turn", None)),
    ],
)
def test_periods_of_the_wrong_size_or_sign_are_refused(name, value):
    wrong = type("Wrong", (Compass,), {name: value})
    with pytest.raises(TypeError, match=f"Wrong: {name}=.*; expected None or"):
        wrong.validate()


def test_a_system_with_angles_conforms():
    check_system(Compass)


def test_the_check_finds_a_state_that_does_not_repeat():
    @dataclass(frozen=True)
    class Wound(Compass):
        """Its rate depends on the number of turns."""

        def f(self, t, x, u):
            return stack(x, x[..., 1], 0.01 * x[..., 0])

        def f_jacobian(self, t, x, u):
            return np.broadcast_to([[0, 1], [0.01, 0]], (*x.shape, 2))

    with pytest.raises(CheckFailed, match="periods: f at heading and at heading"):
        SYSTEM_CHECKS["periods"](Wound)
    with pytest.raises(CheckFailed, match="periods: h at heading and at heading"):
        SYSTEM_CHECKS["periods"](replace_periods(Unwrapped, None, (TURN, None)))


def replace_periods(cls, output_period, state_period):
    """A system that declares other periods."""
    periods = {"output_period": output_period, "state_period": state_period}
    return dataclass(frozen=True)(type("Declared", (cls,), periods))


def test_systems_made_of_others_have_their_angles():
    known = augmented(Compass(), output_bias={"compass": Unknown(0.0, 0.1)})
    assert (known.output_period, known.state_period) == ((TURN,), (TURN, None, None))
    plain = augmented(Unwrapped(), output_bias={"compass": Unknown(0.0, 0.1)})
    assert (plain.output_period, plain.state_period) == (None, None)
    other = OtherRates(Compass(), np.ones((1, 2)))
    assert (other.output_period, other.state_period) == ((TURN,), (TURN, None))


def test_the_scale_of_an_output_does_not_see_the_end_of_its_range():
    """Its differences are taken across π, at the only initial state."""

    @dataclass(frozen=True)
    class North(Compass):
        """It starts at the end of the range."""

        setups = {
            "benchmark": replace(
                Compass.setups["benchmark"], x0_low=(np.pi, 0.0), x0_high=(np.pi, 0.0)
            )
        }
        h_jacobian = System.h_jacobian  # none of its own

        def h(self, t, x, u):
            return np.arctan2(np.sin(x[..., :1]), np.cos(x[..., :1]))

    np.testing.assert_allclose(output_scale(North()), [3.0], rtol=1e-6)
