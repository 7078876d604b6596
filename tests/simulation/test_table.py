"""Tables: values of other libraries, derivatives by differences, and symbols."""

from dataclasses import dataclass

import numpy as np
import pytest
import sympy
import torch
from array_api_compat import array_namespace
from scipy.interpolate import PchipInterpolator

import pinnobs_gym
from pinnobs_gym import Setup, System, table
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.symbolic import trace
from pinnobs_gym.simulation.system import stack

POINTS = (0.0, 0.1, 0.35, 0.5, 0.9, 1.0, 1.7)
VALUES = (3.0, 3.4, 3.5, 3.5, 3.2, 3.9, 4.1)
"""Values that rise, stay, fall and rise again."""
METHODS = ("linear", "monotone")


def slope(method, x, points=POINTS, values=VALUES):
    """dy/dx by central differences."""
    return (
        table(x + 1e-6, points, values, method) - table(x - 1e-6, points, values, method)
    ) / 2e-6


def between(count=200, low=POINTS[0], high=POINTS[-1]):
    return np.random.default_rng(0).uniform(low, high, count)


def test_a_linear_table_is_numpys_and_a_cubic_one_scipys():
    x = np.concatenate([between(), POINTS])
    assert np.allclose(table(x, POINTS, VALUES), np.interp(x, POINTS, VALUES), rtol=0, atol=1e-14)
    peer = PchipInterpolator(POINTS, VALUES)
    assert np.allclose(table(x, POINTS, VALUES, "monotone"), peer(x), rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", [2, 3, 4, 12])
def test_random_cubic_tables_are_scipys(size):
    rng = np.random.default_rng(size)
    for _ in range(50):
        points = np.cumsum(rng.uniform(0.01, 3.0, size))
        values = rng.choice([-1.0, 0.0, 0.5, 2.0, 30.0], size)
        x = rng.uniform(points[0], points[-1], 100)
        found = table(x, points, values, "monotone")
        assert np.allclose(found, PchipInterpolator(points, values)(x), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("method", METHODS)
def test_it_continues_by_the_slope_at_the_end(method):
    peer = PchipInterpolator(POINTS, VALUES).derivative()
    first, last = (4.0, 0.2 / 0.7) if method == "linear" else (peer(0.0), peer(1.7))
    below, above = table(np.array([-2.0, 3.7]), POINTS, VALUES, method)
    assert below == pytest.approx(3.0 - 2 * first, abs=1e-12)
    assert above == pytest.approx(4.1 + 2 * last, abs=1e-12)


def test_the_slope_of_a_cubic_table_is_continuous():
    for point in POINTS:
        left, right = (slope("monotone", np.float64(point + side)) for side in (-2e-6, 2e-6))
        assert left == pytest.approx(right, abs=1e-3)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [(), (4,), (2, 3, 4)])
def test_torch_has_the_values_and_derivatives(method, shape):
    x = between(24, -0.5, 2.0)[: int(np.prod(shape))].reshape(shape)
    tensor, expected = torch.tensor(x), slope(method, x)

    def y(x):
        return table(x, POINTS, VALUES, method)

    assert np.allclose(y(tensor), table(x, POINTS, VALUES, method), rtol=0, atol=1e-14)
    forward = torch.func.jvp(y, (tensor,), (torch.ones_like(tensor),))[1]
    backward = torch.func.grad(lambda x: y(x).sum())(tensor)
    mapped = torch.func.vmap(torch.func.grad(y))(tensor.reshape(-1)).reshape(shape)
    for derivative in (forward, backward, mapped):
        assert np.allclose(derivative, expected, rtol=1e-7, atol=1e-7)
    assert y(tensor.float()).dtype == torch.float32


@dataclass(frozen=True)
class Battery(System):
    """A battery whose open-circuit voltage is a table of its state of charge."""

    state_names = ("SoC",)
    output_names = ("V",)
    scale = (0.3,)
    setups = {"benchmark": Setup((0.3,), (0.9,), duration=10, dt=1, noise_std=0.01)}

    def f(self, t, x, u):
        return stack(x, -1e-3 * array_namespace(x).ones_like(x[..., 0]))

    def h(self, t, x, u):
        return table(x, POINTS, VALUES, "monotone")


def test_a_system_with_a_table_passes_the_checks():
    check_system(Battery)


@pytest.mark.parametrize("method", METHODS)
def test_symbols_give_one_piecewise_expression(method):
    class Other(Battery):
        def h(self, t, x, u):
            return table(x, POINTS, VALUES, method)

    equations = trace(Other())
    expression, symbol = equations.h[0], equations.x[0]
    assert isinstance(expression, sympy.Piecewise)
    x = np.concatenate([between(20, -0.5, 2.0), POINTS])
    found = [float(expression.subs(symbol, value)) for value in x]
    assert np.allclose(found, table(x, POINTS, VALUES, method), rtol=0, atol=1e-12)
    derivative = equations.h_jacobian()[0, 0]
    found = [float(derivative.subs(symbol, value)) for value in x[:20]]
    assert np.allclose(found, slope(method, x[:20]), rtol=0, atol=1e-7)


def test_numbers_integers_and_what_is_not_finite():
    assert table(0.05, POINTS, VALUES) == pytest.approx(3.2)
    assert np.allclose(table(np.array([0, 1]), POINTS, VALUES), [3.0, 3.9])
    assert np.allclose(table(torch.tensor([0, 1]), POINTS, VALUES), [3.0, 3.9])
    assert np.isnan(table(np.array([np.nan, 1.0]), POINTS, VALUES)).tolist() == [True, False]
    assert pinnobs_gym.table is table


@pytest.mark.parametrize(
    ("points", "values", "method", "says"),
    [
        ((0, 1, 1), (0, 1, 2), "linear", "1 is followed by 1; expected increasing"),
        ((0, 2, 1), (0, 1, 2), "linear", "2 is followed by 1; expected increasing"),
        ((0,), (1,), "linear", "a table of 1 points and 1 values; expected"),
        ((0, 1, 2), (0, 1), "linear", "a table of 3 points and 2 values; expected as many"),
        ((0, np.nan), (0, 1), "linear", r"points=\[0.0, nan\]; expected finite"),
        ((0, 1), (0, np.inf), "monotone", r"values=\[0.0, inf\]; expected finite"),
        ((0, 1), ("a", "b"), "linear", "values=.*; expected a sequence of numbers"),
        (1.0, (0, 1), "linear", "points=1.0; expected a sequence of numbers"),
        ((0, 1), (0, 1), "cubic", "unknown method 'cubic' of a table; it has linear, monotone"),
    ],
)
def test_a_wrong_table_is_refused_in_one_line(points, values, method, says):
    with pytest.raises(ValueError, match=says) as raised:
        table(0.5, points, values, method)
    assert "\n" not in str(raised.value)
