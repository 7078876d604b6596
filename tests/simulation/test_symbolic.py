"""The equations as symbols are those of the code, at random states and parameters."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import sympy
from array_api_compat import array_namespace

from pinnobs_gym import Setup, System
from pinnobs_gym.simulation.symbolic import aligned, latex, name_in_latex, rates, trace
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class Pendulum(System):
    """It has what the built-in systems do not: branches, truths as numbers, words for names."""

    length: float = 2.0
    stop: float = 0.5
    damped: bool = True

    state_names = ("angle", "velocity")
    output_names = ("y",)
    input_names = ("u",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1, -1), (1, 1), duration=1, dt=0.1)}

    @property
    def rate(self):
        return 9.81 / self.length

    @property
    def twice(self):
        return 2 * self.rate

    def f(self, t, x, u):
        xp = array_namespace(x)
        angle, velocity = x[..., 0], x[..., 1]
        after = t >= self.stop
        pull = xp.where(velocity > 0, velocity, xp.tanh(velocity))
        driven = u[..., 0] * ((t < self.stop) | (abs(angle) > 1))
        damping = pull + after * xp.maximum(angle, velocity) if self.damped else 0.0
        return stack(x, velocity, -self.twice * xp.sin(angle) - damping + driven)

    def h(self, t, x, u):
        xp = array_namespace(x)
        return xp.atan2(x[..., :1] + u[..., :1], 2 + xp.cos(t * x[..., 1:]))

    def input(self, t):
        xp = array_namespace(t)
        return xp.stack([self.length * xp.exp(-t)], axis=-1)


CLASSES = [*SYSTEMS.classes().values(), Pendulum]


def changed(cls, rng):
    """The system with every number off its default by up to 20 %."""
    system = cls()
    off = {
        name: value * rng.uniform(0.8, 1.2)
        for name, value in system.parameters.items()
        if not isinstance(value, bool)
    }
    if cls.__name__ == "InductionMotor":
        off["M"] = 0.95 * np.sqrt(off["L_s"] * off["L_r"])  # the leakage factor stays positive
    return replace(system, **off)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_symbols_are_the_code(cls):
    rng = np.random.default_rng(0)
    equations = trace(cls())
    symbols = [equations.t, *equations.x, *equations.u, *equations.parameters.values()]
    parts = [equations.f, equations.f_jacobian(), equations.h, equations.h_jacobian()]
    expressions = [equations.expanded(part) for part in (*parts, equations.input)]
    compute = sympy.lambdify(symbols, expressions, "numpy")
    for _ in range(20):
        system = changed(cls, rng)
        t = np.asarray(rng.uniform(0, 1))
        x = rng.standard_normal(system.nx) * system.scale
        u = rng.standard_normal(system.nu)
        values = [getattr(system, name) for name in equations.parameters]
        found = compute(t, *x, *u, *values)
        expected = [
            system.f(t, x, u),
            system.f_jacobian(t, x, u),
            system.h(t, x, u),
            system.h_jacobian(t, x, u),
            system.input(t),
        ]
        for ours, theirs in zip(found, expected, strict=True):
            theirs = np.asarray(theirs).reshape(np.shape(ours))
            np.testing.assert_allclose(np.asarray(ours, float), theirs, rtol=1e-10, atol=1e-12)


def test_what_is_computed_of_parameters_has_a_name():
    equations = trace(SYSTEMS.resolve("InductionMotor")())
    gamma = sympy.Symbol("gamma", real=True)
    assert gamma in equations.f[0].free_symbols
    assert str(equations.definitions[gamma]) == "R_s/(L_s*sigma) + M**2*R_r/(L_r**2*L_s*sigma)"
    assert not equations.expanded(equations.f).free_symbols & set(equations.definitions)


def test_latex():
    equations = trace(SYSTEMS.resolve("ReverseDuffing")())
    lines = aligned(list(zip(rates(equations), equations.f, strict=True)))
    assert lines == "\\dot{x}_{1} &= x_{2}^{3} \\\\\n\\dot{x}_{2} &= - x_{1}"
    assert latex(sympy.Symbol("velocity") ** 2) == r"\mathrm{velocity}^{2}"
    names = {
        "phi1": r"\phi_{1}",
        "omega": r"\omega",
        "T_L": "T_{L}",
        "position": r"\mathrm{position}",
    }
    names["u1_amplitude"] = r"u_{1,\mathrm{amplitude}}"
    assert {name: name_in_latex(name) for name in names} == names


class Branching(Pendulum):
    def f(self, t, x, u):
        return stack(x, x[..., 1], 1.0 if x[..., 0] > 0 else -1.0)


class Short(Pendulum):
    def f(self, t, x, u):
        return x[..., :1]


@pytest.mark.parametrize(
    ("cls", "message"),
    [
        (Branching, "Branching cannot be traced: TypeError: cannot determine truth value"),
        (Short, r"Short cannot be traced: ValueError: .* shape \(1,\); expected \(2,\)"),
    ],
)
def test_what_cannot_be_traced_is_told_in_one_line(cls, message):
    with pytest.raises(ValueError, match=message) as told:
        trace(cls())
    assert "\n" not in str(told.value)
