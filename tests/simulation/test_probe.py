"""Mistakes of a new user's model, each of which is one line that says where it is."""

import inspect
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from pinnobs_gym.cli import main
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import register_system
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.particle import ParticleFilter
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.checks import check_system
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.probe import ModelError, probe
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import Setup, System, independent, matrix, stack
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class Sound(System):
    state_names = ("a", "b")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (-1, -1),
            (1, 1),
            duration=2.0,
            dt=0.1,
            noise_std=0.1,
            xhat0=(0, 0),
            P0=independent(1, 1),
        )
    }

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -x[..., 0])

    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., :1]


class HWithoutLastAxis(Sound):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return x[..., 0]  # wrong


class HOfTwo(Sound):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        if len(x) > 1:
            return x  # wrong
        return x[..., :1]


class FOfThree(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -x[..., 0], 0.0)  # wrong


class MathSin(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(
            x,
            x[..., 1],
            -math.sin(x[..., 0]),  # wrong
        )


class IfState(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        if x[..., 0] > 0:  # wrong
            return stack(x, x[..., 1], -x[..., 0])
        return stack(x, x[..., 1], -2 * x[..., 0])


class FirstRow(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[1], -x[0])  # wrong


class NoSuchState(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 2], -x[..., 0])  # wrong


class MissingName(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -omega * x[..., 0])  # noqa: F821 # pyright: ignore  # wrong


class NoSuchParameter(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -self.k * x[..., 0])  # pyright: ignore  # wrong


class ListOfRates(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        return [x[..., 1], -x[..., 0]]  # wrong


class Nothing(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:
        _ = stack(x, x[..., 1], -x[..., 0])  # wrong


class Noisy(Sound):
    def f(self, t: Any, x: Any, u: Any) -> Any:  # wrong
        return stack(x, x[..., 1], np.random.default_rng().standard_normal())


class OneRowJacobian(Sound):
    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return np.array([[0.0, 1.0], [-1.0, 0.0]])  # wrong


class ScalarInput(Sound):
    input_names = ("u",)

    def input(self, t: Any) -> Any:
        return 0 * t  # wrong


class AdmissibleByAnd(Sound):
    def admissible(self, x0: Any) -> Any:
        return x0[..., 0] > 0 and x0[..., 1] > 0  # wrong


FAULTS = [
    (
        HWithoutLastAxis,
        "h",
        r"returns shape \(2,\) for t \(2,\), x \(2, 2\), u \(2, 0\); .*\(2, 1\)",
    ),
    (HOfTwo, "h", r"returns shape \(2, 2\) .* expected shape \(2, 1\)"),
    (FOfThree, "f", r"returns shape \(2, 3\) .* expected shape \(2, 2\)"),
    (MathSin, "f", r"raises TypeError: only .* expected shape \(2, 2\), by array functions"),
    (IfState, "f", r"raises ValueError: The truth value .* expected"),
    (FirstRow, "f", r"raises ValueError: could not broadcast .* x\[\.\.\., 0\]"),
    (NoSuchState, "f", r"raises IndexError: index 2 .* expected"),
    (MissingName, "f", r"raises NameError: name 'omega' is not defined"),
    (NoSuchParameter, "f", r"raises AttributeError: 'NoSuchParameter' object has no attribute 'k'"),
    (ListOfRates, "f", r"returns list .* expected shape \(2, 2\)"),
    (Nothing, "f", r"returns NoneType .* expected shape \(2, 2\)"),
    (Noisy, "f", "returns other values when called again .* the same at each call"),
    (
        OneRowJacobian,
        "f_jacobian",
        r"returns shape \(2, 2\) .* expected shape \(2, 2, 2\)|\(3, 2, 2\)",
    ),
    (ScalarInput, "input", r"returns shape \(3,\) for t \(3,\); expected shape \(3, 1\)"),
    (AdmissibleByAnd, "admissible", r"raises ValueError: .* for x \(3, 2\); expected shape \(3,\)"),
]


def line_of(cls: type[System]) -> int:
    """The line of this file that ends with the comment that it is wrong."""
    lines, first = inspect.getsourcelines(cls)
    return first + next(i for i, line in enumerate(lines) if line.rstrip().endswith("# wrong"))


@pytest.mark.parametrize(("cls", "name", "says"), FAULTS)
def test_a_mistake_is_one_line_that_says_where(cls: type[System], name: str, says: str) -> None:
    where = rf"^{cls.__name__}\.{name} \(test_probe\.py, line {line_of(cls)}\) "
    with pytest.raises(ModelError, match=f"{where}.*{says}") as caught:
        probe(cls)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.fixture(autouse=True)
def own_systems() -> Iterator[None]:
    """The systems registered by a test are forgotten after it."""
    before = dict(gym.registry)
    with SYSTEMS.isolated():
        yield
    gym.registry.clear()
    gym.registry.update(before)


@pytest.mark.parametrize("cls", [HWithoutLastAxis, MathSin])
def test_it_is_told_wherever_the_model_is_first_used(cls: type[System]) -> None:
    setup = Sound.setups["benchmark"]
    says = rf"{cls.__name__}\.. \(test_probe\.py, line {line_of(cls)}\)"
    with pytest.raises(ModelError, match=says):
        EKF.for_setup(cls(), setup)
    with pytest.raises(ModelError, match=says):
        Game.of(cls)
    with pytest.raises(CheckFailed, match=f"^equations: {says}[^\n]*$"):
        check_system(cls)
    register_system(cls)
    with pytest.raises(ModelError, match=says):
        gym.make(f"pinnobs/{cls.__name__}-v0")


COMMANDS = [
    ["systems", "{}"],
    ["evaluate", "--system", "{}", "--episodes", "1"],
    ["estimate", "--system", "{}", "--log", "log.csv"],
    ["train", "kkl_pinn", "--system", "{}"],
]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda c: c[0])
def test_commands_print_the_line(
    command: list[str], tmp_path: Any, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("t,y1\n0,1\n0.1,1\n")
    status = main([part.format(f"{__name__}:IfState") for part in command])
    told = capsys.readouterr()
    assert status == 2
    line = line_of(IfState)
    assert told.err.startswith(f"pinnobs: error: IfState.f (test_probe.py, line {line}) raises")
    assert told.err.count("\n") == 1


@dataclass(frozen=True)
class NumPyOnly(Sound):
    """A pendulum that torch cannot differentiate."""

    def f(self, t: Any, x: Any, u: Any) -> Any:
        return stack(x, x[..., 1], -np.sin(x[..., 0]))  # wrong


class WithJacobian(NumPyOnly):
    def f_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[0.0, 1.0], [-np.cos(x[..., 0]), 0.0]])

    def h_jacobian(self, t: Any, x: Any, u: Any) -> Any:
        return matrix(x, [[1.0, 0.0]])


class HInNumPy(Sound):
    def h(self, t: Any, x: Any, u: Any) -> Any:
        return np.arctan(2 * x[..., :1])


def record(system: System, setup: Setup) -> Record:
    y = 0.5 * np.cos(setup.times)[None, :, None]
    return Record(setup.times, y, np.zeros((1, len(setup.times), 0)), Prior.of(system, setup, 1))


def test_a_model_in_numpy_runs_the_estimators_that_need_no_torch() -> None:
    probe(NumPyOnly)
    system, setup = NumPyOnly.configured()
    given = record(system, setup)
    for kind in (UKF, ParticleFilter, EKF):
        assert np.isfinite(kind.for_setup(system, setup).run(given).xhat).all()
    assert np.isfinite(EKF.for_setup(WithJacobian(), setup).run(given).xhat).all()


def test_what_needs_torch_says_so_in_one_line() -> None:
    """Trainers differentiate torch tensors."""
    where = rf"^NumPyOnly\.f \(test_probe\.py, line {line_of(NumPyOnly)}\) raises .*"
    x, t, u = torch.ones(3, 2, requires_grad=True), torch.zeros(3), torch.zeros(3, 0)
    with pytest.raises(
        ModelError, match=f"{where}torch tensors, which f_jacobian needs; "
    ) as caught:
        NumPyOnly().f_jacobian(t, x, u)
    assert "\n" not in str(caught.value)


def test_the_scale_of_an_output_in_numpy() -> None:
    """The slope of arctan(2a) is at most 2, at a = 0; the noise is at least 1e-3 of that scale."""
    at_zero = replace(
        Sound.setups["benchmark"], x0_low=(0.0, 0.0), x0_high=(0.0, 0.0), noise_std=0.0
    )
    cls = type("AtZero", (HInNumPy,), {"setups": {"benchmark": at_zero}})
    std = np.sqrt(UKF.for_setup(cls(), at_zero).noise.R(0.0)[0, 0])
    assert std == pytest.approx([2e-3], rel=1e-8)
