"""Jacobians that nobody wrote: against those by hand, torch's, differences and closed forms."""

import logging
import subprocess
import sys
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
import torch
from array_api_compat import array_namespace

from pinnobs_gym import Setup, System, Unknown, augmented, stack, table
from pinnobs_gym.simulation import derivatives
from pinnobs_gym.simulation.derivatives import central_differences
from pinnobs_gym.simulation.model import model_step_jacobian
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.system import initial_states, matrix, output_scale
from pinnobs_gym.systems import SYSTEMS

NAMES = ("f_jacobian", "h_jacobian")
SETUPS = {"benchmark": Setup((-1, -1), (1, 1), duration=1.0, dt=0.1)}


def without_jacobians(cls: type[System]) -> type[System]:
    return type(cls.__name__, (cls,), {name: getattr(System, name) for name in NAMES})


@dataclass(frozen=True)
class Plain(System):
    """Two states, of which subclasses write the equations."""

    k: float = 1.3
    n: float = 2.0

    state_names = ("a", "b")
    output_names = ("y",)
    input_names = ("u1",)
    scale = (1.0, 2.0)
    setups = SETUPS

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -x[..., 0])

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., :1]


@pytest.fixture(autouse=True)
def nothing_said() -> None:
    say_once.cache_clear()
    derivatives._latest.clear()


def points(system: System, *batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.uniform(-2, 2, (*batch, system.nx)) * system.scale
    return rng.uniform(0, 1, batch), x, rng.uniform(-1, 1, (*batch, system.nu))


@pytest.mark.parametrize("name", SYSTEMS.classes())
def test_they_are_those_by_hand(name: str, caplog: Any) -> None:
    cls = SYSTEMS.resolve(name)
    by_hand, plain = cls(), without_jacobians(cls)()
    for batch in ((), (1,), (5,), (2, 3)):
        given = points(by_hand, *batch)
        for name in NAMES:
            expected = getattr(by_hand, name)(*given)
            found = getattr(plain, name)(*given)
            size = abs(expected).max()
            np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14 * size)
            assert found.strides == expected.strides
    assert not caplog.records


# Each in the array API, of components a and b, input u, time t, and parameters k and n.
FORMULAS = {
    "product and quotient": lambda xp, a, b, u, t, k, n: k * a * b / (2 + b * b) - a / (3.0 * k),
    "whole powers": lambda xp, a, b, u, t, k, n: a**3 - 2 * b**7 + a**-2 + (a - b) ** 5 + b**19,
    "broken powers": lambda xp, a, b, u, t, k, n: (
        (a * a + 1) ** 0.3 + (b * b + k) ** -1.5 + xp.sqrt(2 + a) + (3 + a) ** 2.5
    ),
    "exponents that are parameters": lambda xp, a, b, u, t, k, n: (
        (a * a + 0.1) ** n + (5 + b) ** (-k)
    ),
    "sines": lambda xp, a, b, u, t, k, n: xp.sin(k * a) * xp.cos(b) + xp.tan(a / 3) + xp.cos(t * a),
    "hyperbolic": lambda xp, a, b, u, t, k, n: xp.sinh(a) - xp.cosh(b) + xp.tanh(a * b),
    "exponentials": lambda xp, a, b, u, t, k, n: (
        xp.exp(-a * a / k) + xp.log(5 + b) + xp.expm1(a) + xp.log1p(b * b)
    ),
    "logarithms": lambda xp, a, b, u, t, k, n: xp.log10(3 + a) - xp.log2(4 + a * b),
    "inverse": lambda xp, a, b, u, t, k, n: (
        xp.asin(a / 4) + xp.acos(b / 5) + xp.atan(a * b) + xp.asinh(a) + xp.acosh(3 + a)
    ),
    "inverse of tanh": lambda xp, a, b, u, t, k, n: xp.atanh(a * b / 10),
    "angle": lambda xp, a, b, u, t, k, n: xp.atan2(a - u, b + k),
    "distance": lambda xp, a, b, u, t, k, n: xp.hypot(a - k, b + u) + xp.square(a),
    "size": lambda xp, a, b, u, t, k, n: abs(a * b) + xp.abs(xp.log(5 + b) - 1) * b,
    "sign": lambda xp, a, b, u, t, k, n: k * xp.sign(b) * b * b + xp.sign(a - 0.1),
    "root of a square": lambda xp, a, b, u, t, k, n: xp.sqrt((a - b) ** 2) + xp.sqrt(a * a) * b,
    "whole part": lambda xp, a, b, u, t, k, n: xp.floor(a) * b + a,
    "remainder": lambda xp, a, b, u, t, k, n: (a * b) % 0.7 + b,
    "largest": lambda xp, a, b, u, t, k, n: (
        xp.maximum(xp.maximum(a, b), a * b) * xp.minimum(a, xp.exp(b)) + xp.maximum(a, k)
    ),
    "within limits": lambda xp, a, b, u, t, k, n: k * xp.clip(a * b, -0.5, 0.8) + a,
    "choice": lambda xp, a, b, u, t, k, n: xp.where(
        (a > 0) & ~(b < -0.5) | (t > 0.5), a * xp.exp(b), xp.where(b != 0.25, a * a, b)
    ),
    "truths as numbers": lambda xp, a, b, u, t, k, n: (a > b) * a * a + u * (t >= 0.3) * b,
    "linear table": lambda xp, a, b, u, t, k, n: table(a, (-1, 0, 0.3, 1), (0, 2, 1, 5)) * b,
    "cubic table": lambda xp, a, b, u, t, k, n: table(
        a * b, (-1, 0, 0.3, 1, 2), (0, 2, 3, 1, 5), "monotone"
    ),
}


def plant(formula: Any) -> type[Plain]:
    @dataclass(frozen=True)
    class Made(Plain):
        def f(self, t: Any, x: Any, u: Any) -> Any:
            a, b = x[..., 0], x[..., 1]
            # Not a's square alone: that all shapes agree is not what is tested here.
            t = t + 0 * a
            return stack(x, formula(array_namespace(x), a, b, u[..., 0], t, self.k, self.n), b * a)

    return Made


@pytest.mark.parametrize("formula", FORMULAS.values(), ids=list(FORMULAS))
def test_they_are_torchs(formula: Any, caplog: Any) -> None:
    system = replace(plant(formula)(), k=0.7, n=1.5)
    t, x, u = points(system, 40)
    found = system.f_jacobian(t, x, u)
    assert not caplog.records
    expected = system.f_jacobian(*map(torch.tensor, (t, x, u))).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11)
