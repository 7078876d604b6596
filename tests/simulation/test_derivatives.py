"""Jacobians that nobody wrote: against those by hand, torch's, differences and closed forms."""

import logging
import os
import re
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
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
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.system import initial_states, matrix, output_scale
from pinnobs_gym.simulation.traced_code import Trace
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


def test_values_and_slopes_where_branches_meet() -> None:
    """The mean of both sides for maxima, zero for jumps; a branch that is not taken adds nothing,
    as of √max(a, 0) below zero, and of the logarithm of a negative number."""

    def formula(xp: Any, a: Any, b: Any, u: Any, t: Any, k: Any, n: Any) -> Any:
        tank = xp.sqrt(xp.maximum(a, 0.0)) * k
        return tank + xp.maximum(2 * b, b) + xp.where(b > -1, xp.sign(b), xp.log(b))

    x = np.array([[-1.0, 0.0], [4.0, -0.5], [-2.0, 3.0]])
    found = plant(formula)().f_jacobian(0.0, x, np.zeros((3, 1)))[:, 0]
    assert np.array_equal(found, [[0.0, 1.5], [1.3 / 4, 1.0], [0.0, 2.0]])


def test_parameters_are_arguments_and_may_be_one_per_row(monkeypatch: Any) -> None:
    cls = plant(lambda xp, a, b, u, t, k, n: k * xp.sin(n * a) * b)
    t, x, u = points(cls(), 5)
    cls().f_jacobian(t, x, u)
    monkeypatch.setattr("pinnobs_gym.simulation.traced_code.Trace", None)  # none is made any more
    k = np.array([0.3, -1.0, 2.0, 5.0, 0.0])
    together = replace(cls(), k=k, n=3).f_jacobian(t, x, u)  # pyright: ignore
    for i in range(5):
        alone = replace(cls(), k=float(k[i]), n=3).f_jacobian(t[i], x[i], u[i])
        expected = 3 * k[i] * np.cos(3 * x[i, 0]) * x[i, 1]
        assert alone[0, 0] == pytest.approx(expected, rel=1e-13)
        assert np.array_equal(together[i], alone)


@pytest.mark.parametrize("formula", FORMULAS.values(), ids=list(FORMULAS))
def test_a_row_is_the_same_alone_and_in_any_batch(formula: Any) -> None:
    system = plant(formula)()
    t, x, u = points(system, 4, 37)
    last = np.ascontiguousarray(x.transpose(0, 2, 1)).transpose(0, 2, 1)
    together = system.f_jacobian(t, x, u)
    assert np.array_equal(together, system.f_jacobian(t, last, u))
    for at in ((0, 0), (1, 5), (3, 36)):
        assert np.array_equal(together[at], system.f_jacobian(t[at], x[at], u[at]))
        row = tuple(part[at[0], None, at[1] : at[1] + 1] for part in (t, x, u))
        assert np.array_equal(together[at], system.f_jacobian(*row)[0, 0])


def test_time_and_input_broadcast() -> None:
    system = plant(FORMULAS["angle"])()
    _, x, _ = points(system, 2, 3)
    t, u = np.array([[0.2], [0.4]]), np.array([[[0.3]], [[0.5]]])
    found = system.f_jacobian(t, x, u)
    for at in np.ndindex(2, 3):
        assert np.array_equal(found[at], system.f_jacobian(t[at[0], 0], x[at], u[at[0], 0]))
    assert found.dtype == float
    single = system.f_jacobian(*(part.astype(np.float32) for part in (t, x, u)))
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, found, rtol=1e-5)


@dataclass(frozen=True)
class SameNames(Plain):
    """A state, an input and a parameter have one name, and its property another's."""

    state_names = ("k", "t")
    input_names = ("k",)

    @property
    def x0(self) -> float:
        return 3 * self.n

    def f(self, t: Any, x: Any, u: Any) -> Any:
        k, other = x[..., 0], x[..., 1]
        return stack(x, self.k * k * k + u[..., 0] * other, self.x0 * other + t)


def test_names_that_occur_twice_are_told_apart(caplog: Any) -> None:
    found = SameNames(k=5.0).f_jacobian(0.3, np.array([2.0, 7.0]), np.array([11.0]))
    assert np.array_equal(found, [[20.0, 11.0], [0.0, 6.0]])
    assert not caplog.records


@dataclass(frozen=True)
class Mixed(Plain):
    """A parameter of each kind, with functions of numbers that need no array."""

    gains: tuple[float, ...] = (1.0, 2.0)
    cubed: bool = False
    delay: float = field(default=0.5, kw_only=True)

    def f(self, t: Any, x: Any, u: Any) -> Any:
        a, b = x[..., 0], x[..., 1]
        rate = np.sqrt(self.k) * a**3 if self.cubed else self.gains[1] * a
        return stack(x, rate + self.delay * b, np.maximum(x @ np.array(self.gains), -9.0))


def test_parameters_that_are_no_numbers_are_part_of_the_code(caplog: Any) -> None:
    x, u = np.array([0.5, 0.2]), np.zeros(1)
    for gains, cubed, delay in (((1.0, 2.0), False, 0.5), ((3.0, -4.0), True, 0.7)):
        system = Mixed(k=4.0, gains=gains, cubed=cubed, delay=delay)
        found = system.f_jacobian(0.0, x, u)
        first = 2 * 3 * 0.5**2 if cubed else gains[1]
        np.testing.assert_allclose(found, [[first, delay], gains], rtol=1e-14)
    assert not caplog.records


class BranchesOnNumbers(Plain):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        y = np.empty_like(x[..., :1])
        for at in np.ndindex(x.shape[:-1]):
            y[at] = np.sin(x[at][0]) if x[at][0] > 0 else 2 * x[at][1]
        return y


class UnknownFunction(Plain):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return np.interp(x[..., :1], [-9.0, 9.0], [-9.0, 9.0]) + np.i0(x[..., 1:])


class IfParameterIsZero(Plain):
    """Symbols are not zero, so that tracing would always take the second branch."""

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., :1] if self.k == 0 else self.k * x[..., 1:]


class IfSymbol(Plain):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return (1.0 if x.dtype == float else 2.0) * x[..., :1] * x[..., 1:]


@pytest.mark.parametrize(
    ("cls", "reason"),
    [
        (BranchesOnNumbers, "TypeError: .*"),
        (UnknownFunction, "TypeError: .*"),
        (IfParameterIsZero, "TypeError: cannot determine truth value of Relational: .*"),
        (IfSymbol, "the traced equations give other values"),
    ],
)
def test_what_cannot_be_traced_has_differences_and_says_so_once(
    cls: type[Plain], reason: str, caplog: Any
) -> None:
    caplog.set_level(logging.WARNING)
    t, x, u = points(cls(), 6)
    found = cls().h_jacobian(t, x, u)
    (told,) = caplog.messages
    says = rf"{cls.__name__}\.h cannot be differentiated by its equations \({reason}\); its "
    assert pytest.approx(found, rel=1e-9) == cls().h_jacobian(t, x, u)
    assert re.fullmatch(says + "Jacobian is found by finite differences", told)
    for i in range(6):
        assert np.array_equal(cls().h_jacobian(t[i], x[i], u[i]), found[i])
        expected = np.zeros(2)
        a, b = x[i]
        if cls is BranchesOnNumbers:
            expected[:] = (np.cos(a), 0) if a > 0 else (0, 2)
        elif cls is UnknownFunction:
            from scipy.special import i1

            expected[:] = 1, i1(b)
        elif cls is IfParameterIsZero:
            expected[1] = 1.3
        else:
            expected[:] = b, a
        np.testing.assert_allclose(found[i, 0], expected, rtol=1e-8, atol=1e-9)
    assert len(caplog.messages) == 1
    assert np.array_equal(cls().f_jacobian(t, x, u)[0], [[0, 1], [-1, 0]])  # f can be traced
    assert len(caplog.messages) == 1


def test_a_branch_on_a_parameter_takes_the_branch_of_its_value() -> None:
    found = IfParameterIsZero(k=0.0).h_jacobian(0.0, np.ones(2), np.zeros(1))
    np.testing.assert_allclose(found, [[1.0, 0.0]], atol=1e-9)


def test_differences_of_a_polynomial() -> None:
    """Central differences are exact for squares, but for rounding, at any size of x."""
    x = np.array([[3.0, 1e6], [-1e-3, 0.0]])
    found = central_differences(lambda x: x * x[..., ::-1], x, (1.0, 100.0))
    for row, (a, b) in zip(found, x, strict=True):
        size = max(abs(a), 1.0) * max(abs(b), 100.0)
        np.testing.assert_allclose(row, [[b, a], [b, a]], atol=1e-10 * size)
    one = central_differences(lambda x: x * x[..., ::-1], x, (1.0, 100.0), [1])
    assert np.array_equal(one, found[..., 1:])
    single = central_differences(np.sin, x[:1, :1].astype(np.float32), (1.0,))
    assert single.dtype == np.float32
    assert single[0, 0, 0] == pytest.approx(np.cos(3.0), rel=1e-6)


def test_the_models_step_uses_them() -> None:
    """A filter's F of a plant without Jacobians is that of the plant with them."""
    cls = SYSTEMS.resolve("Satellite")
    x = initial_states(cls(), cls.setups["benchmark"], 7)
    expected = model_step_jacobian(cls(), 0.0, 0.3, x)
    found = model_step_jacobian(without_jacobians(cls)(), 0.0, 0.3, x)
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(output_scale(without_jacobians(cls)()), output_scale(cls()), 1e-9)


class GainByHand(Plain):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, self.k * x[..., 0] ** 2)

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[2 * self.k * x[..., 0] + 7.0, 0.0]])  # no derivative of h


def test_an_augmented_system_uses_the_jacobian_by_hand_where_there_is_one() -> None:
    """Of h it is the plant's own, recognised by its error; of f it is traced with the unknown."""
    system = augmented(GainByHand(), {"k": Unknown(1.3, 0.2)}, {"y": Unknown(0.0, 1.0)})
    x, u = np.array([0.5, 0.25, 2.0, 0.1]), np.zeros(1)
    found = system.h_jacobian(0.0, x, u)
    np.testing.assert_allclose(found, [[9.0, 0.0, 0.25, 1.0]], rtol=0, atol=1e-9)
    whole = augmented(plant(FORMULAS["product and quotient"])(), {"k": Unknown(1.3, 0.2)})
    t, x, u = points(whole, 20)
    expected = whole.f_jacobian(*map(torch.tensor, (t, x, u))).numpy()
    np.testing.assert_allclose(whole.f_jacobian(t, x, u), expected, rtol=1e-11, atol=1e-11)


def test_deep_nesting_stays_small(caplog: Any) -> None:
    """As a whole, this expression of 40 choices in each other would have 2⁴⁰ terms."""

    def nested(xp: Any, a: Any, b: Any, u: Any, t: Any, k: Any, n: Any) -> Any:
        for i in range(20):
            a = xp.where(a > b, xp.sin(k * a + i) + a, a * b)
            a = xp.maximum(a, xp.minimum(0.3 * a + b, b))
        return a

    system = plant(nested)()
    t, x, u = (part[:, ...] for part in points(system, 10))
    expected = system.f_jacobian(*map(torch.tensor, (t, x, u))).numpy()
    np.testing.assert_allclose(system.f_jacobian(t, x, u), expected, rtol=1e-9, atol=1e-12)
    assert not caplog.records


ASKS = """
import sys
import numpy as np
from pinnobs_gym import evaluate
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
evaluate("ekf", "pinnobs/ReverseDuffing-v0", episodes=1)
assert not {"sympy", "torch"} & set(sys.modules)
class Plain(ReverseDuffing):
    f_jacobian = System.f_jacobian
Plain().f_jacobian(0.0, np.ones(2), np.zeros(0))
assert "sympy" in sys.modules and "torch" not in sys.modules
"""


def test_only_traced_jacobians_import_sympy_and_none_imports_torch() -> None:
    """Where the compiled filter is in the cache: a first process traces it, if nothing else has."""
    for script in (ASKS.split("assert")[0], ASKS):
        subprocess.run([sys.executable, "-c", script], check=True)


SOURCE = """
import sys
sys.path.insert(0, {folder!r})
from test_derivatives import FORMULAS, code_of
print(*map(code_of, FORMULAS.values()), sep="", end="")
"""


def test_the_code_is_the_same_in_every_process() -> None:
    """Sets of symbols have another order in each process."""
    there = subprocess.run(
        [sys.executable, "-c", SOURCE.format(folder=str(Path(__file__).parent))],
        check=True,
        capture_output=True,
        text=True,
        env={
            **os.environ,
            "PYTHONHASHSEED": "2" if os.environ.get("PYTHONHASHSEED") == "1" else "1",
        },
    ).stdout
    assert there == "".join(code_of(formula) for formula in FORMULAS.values())


def code_of(formula: Any) -> str:
    trace = Trace(plant_form(plant(formula)()), "f")
    return f"{trace.source(trace.jacobian(), 'matrix')}\n"
