"""The libraries of plants: which numbers they are valid for, and how they are found again."""

import math
import os
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from fake_compilers import in_process, needs_compiler, output_of

from pinnobs_gym import Setup, System, Unknown, augmented, evaluate, stack
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.simulation.kernels import plant_library as module
from pinnobs_gym.simulation.kernels.agreement import agrees, evaluated
from pinnobs_gym.simulation.kernels.plant_code import plant_code
from pinnobs_gym.simulation.kernels.plant_library import PlantLibrary, plant_library, why_not
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.simulation.system import matrix
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

pytestmark = needs_compiler


@dataclass(frozen=True)
class Base(System):
    """A plant whose equations depend on its parameters in many ways, each in a subclass."""

    k: float = 1.0
    state_names = ("a", "b")
    output_names = ("y",)
    scale = (1.0, 2.0)
    setups = {"benchmark": Setup((-1.0, -1.0), (1.0, 1.0), duration=1.0, dt=0.1, noise_std=0.1)}

    def force(self, t, a):
        raise NotImplementedError

    def f(self, t, x, u):
        return stack(x, x[..., 1], self.force(t, x[..., 0]))

    def h(self, t, x, u):
        return x[..., :1]

    def f_jacobian(self, t, x, u):
        up, down = (self.force(t, x[..., 0] + d) for d in (1e-5, -1e-5))
        return matrix(x, [[0.0, 1.0], [(up - down) / 2e-5, 0.0]])


class Truth(Base):
    """Python takes a symbol as true."""

    def force(self, t, a):
        return -a / self.k if self.k else 0.0 * a


class Infinite(Base):
    """SymPy knows that a real symbol is not infinite."""

    def force(self, t, a):
        return -a if self.k == math.inf else -3.0 * a * self.k


class IsInfinite(Base):
    def force(self, t, a):
        return -a if math.isinf(self.k) else -3.0 * a * self.k


class NumpyIsInfinite(Base):
    def force(self, t, a):
        return -a if np.isinf(self.k) else -3.0 * a * self.k


class Typed(Base):
    def force(self, t, a):
        return -2.0 * a if isinstance(self.k, float) else -a * self.k


class Signed(Base):
    def force(self, t, a):
        return -a * self.k if self.k > 0 else 5.0 * a


class Missing(Base):
    def force(self, t, a):
        return -7.0 * a if self.k is None else -a * self.k


class Property(Base):
    @property
    def rate(self):
        return 0.0 if math.isinf(self.k) else 1.0 / self.k

    def force(self, t, a):
        return -a * self.rate


class InfiniteProperty(Base):
    @property
    def time(self):
        return math.inf if self.k == 0 else 1.0 / self.k

    def force(self, t, a):
        return -a if self.time == math.inf else -2.0 * a * self.time


class Stepped(Base):
    def force(self, t, a):
        return -a * (self.k + (t > 0.5) * 1.0)


CASES = [
    (Truth, (0.0, 1.0, 2.0)),
    (Infinite, (1.0, math.inf)),
    (IsInfinite, (1.0, math.inf)),
    (NumpyIsInfinite, (math.inf, 2.0)),
    (Typed, (2.0, 3)),
    (Signed, (2.0, -2.0, 3.0)),
    (Missing, (None, 1.0)),
    (Property, (1.0, math.inf)),
    (InfiniteProperty, (0.0, 2.0)),
    (Stepped, (1.0, 2.0)),
]


def points(system, count=20):
    rng = np.random.default_rng(1)
    t = rng.uniform(0, 1, count)
    return t, rng.normal(size=(count, system.nx)), np.asarray(system.input(t))


def assert_same(system, made):
    """The compiled functions give the plant's own values."""
    t, x, u = points(system)
    found = evaluated(system, made.code, made.numbers, t, x, u)
    np.testing.assert_allclose(found[0], system.f(t, x, u), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[2], system.h(t, x, u), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[1], system.f_jacobian(t, x, u), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize(("cls", "values"), CASES)
def test_no_number_is_served_by_the_code_of_another(cls, values, order):
    for value in values[::order]:
        system = cls(value)
        made = plant_library(system, "ekf")
        assert isinstance(made, PlantLibrary), made
        assert_same(system, made)


def test_numbers_that_equations_do_not_branch_on_share_a_library():
    one, two = plant_library(Stepped(1.0), "ekf"), plant_library(Stepped(2.0), "ekf")
    assert isinstance(one, PlantLibrary)
    assert isinstance(two, PlantLibrary)
    assert one.numbers == two.numbers == ("k",)
    assert one.code is two.code


def test_equations_that_branch_on_numbers_are_compiled_a_few_times_only(monkeypatch, caplog):
    monkeypatch.setattr(module, "MOST_FORMS", 3)

    class Other(Signed):
        pass

    found = [plant_library(Other(float(k)), "ekf") for k in range(1, 6)]
    assert isinstance(found[0], PlantLibrary)
    assert "cannot be traced: TypeError" in found[-1]
    assert "Other is computed in NumPy, which takes longer: its equations" in caplog.text
    assert len(caplog.records) == 1


@dataclass(frozen=True)
class Kinds(Base):
    flag: bool = False
    mode: str = "soft"
    gains: tuple = (1.0, 2.0)
    table: Any = None
    start: float = field(default=math.inf, kw_only=True)

    def force(self, t, a):
        gain = self.gains[0] * (2.0 if self.mode == "soft" else 3.0) + self.gains[-1] * self.flag
        if self.table is not None:
            gain = gain + self.table[0] * self.table[1]
        if not math.isinf(self.start):
            gain = gain + (t >= self.start)
        return -self.k * gain * a


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"flag": True},
        {"mode": "hard"},
        {"gains": (3.0, 4.0, 5.0)},
        {"table": np.array([2.0, 3.0])},
        {"start": 0.4},
        {"start": np.float64(0.2)},
        {"k": np.linspace(1, 2, 20)},
        {"k": np.linspace(1, 2, 20), "flag": True},
        {"k": 3},
        {"measured_input": True},
    ],
)
def test_other_parameters_are_parts_of_the_code(changes):
    system = replace(Kinds(), **changes)
    made = plant_library(system, "ekf")
    assert isinstance(made, PlantLibrary), made
    assert_same(system, made)


def test_one_number_per_row_is_compared_row_by_row():
    system = Stepped(np.array([1.0, 2.0, 3.0]))
    made = plant_library(system, "ekf")
    assert isinstance(made, PlantLibrary)
    assert agrees(system, made.code, made.numbers)
    branching = plant_library(IsInfinite(np.array([1.0, 2.0])), "ekf")
    assert "cannot be traced" in branching
    infinite = plant_library(Stepped(np.array([1.0, math.inf])), "ekf")
    assert "k differs between rows, and it is not finite in all" in infinite


def test_another_library_does_not_agree():
    """An entry of the index that tells the wrong library gives no other values."""
    one, two = plant_library(Stepped(), "ekf"), plant_library(Property(), "ekf")
    assert isinstance(one, PlantLibrary)
    assert isinstance(two, PlantLibrary)
    assert not agrees(Stepped(), two.code, ("k",))
    assert agrees(Stepped(), one.code, ("k",))


@pytest.mark.parametrize("name", list(SYSTEMS.classes()))
def test_every_system_agrees_with_and_without_its_own_jacobian(name):
    cls = SYSTEMS.resolve(name)
    made = plant_library(cls(), "ekf")
    assert isinstance(made, PlantLibrary), made
    bare = type("Bare", (cls,), {"f_jacobian": System.f_jacobian, "h_jacobian": System.h_jacobian})
    assert agrees(bare(), made.code, made.numbers)
    assert agrees(cls(), made.code, made.numbers)


def both_ways(monkeypatch, run):
    """What a function returns with compiled code, and without."""
    results = [run()]
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    results.append(run())
    monkeypatch.delenv("PINNOBS_KERNELS")
    return results


def test_the_motor_under_a_load_step_scores_the_same(monkeypatch):
    def run():
        return evaluate("ekf", "pinnobs/InductionMotor-v0", condition="load_step", episodes=3)

    def numbers(rows):
        scored = [{k: v for k, v in r.items() if isinstance(v, float)} for r in rows]
        return [{k: v for k, v in r.items() if k != "us_per_step"} for r in scored]

    for a, b in zip(*map(numbers, both_ways(monkeypatch, run)), strict=True):
        assert a == pytest.approx(b, rel=1e-8, nan_ok=True)
        assert len(a) > 5


def stepping(torque):
    return replace(InductionMotor(), load_step_time=0.02, load_step_torque=torque)


@pytest.mark.parametrize(
    "torque", [0.0, 30.0, np.array([0.0, 10.0, 400.0])], ids=["0", "30", "by row"]
)
def test_a_model_with_the_load_step_estimates_the_same(monkeypatch, torque):
    """Its time is a part of the code, the torque of each row a number."""
    source = EpisodeSource(InductionMotor, duration=0.05)
    setup, record = source.setup, source.record(source.play(source.draw(source.streams(range(3)))))
    system = stepping(torque)

    def run():
        filtered = EKF(system, noise_std=setup.noise_std)
        assert (filtered.compiled is None) == (os.environ.get("PINNOBS_KERNELS") == "0")
        return filtered.run(record).xhat

    with_kernels, without = both_ways(monkeypatch, run)
    size = abs(without).max(axis=(0, 1))
    assert (abs(with_kernels - without) / size).max() < 1e-9
    plain = EKF(InductionMotor(), noise_std=setup.noise_std).run(record).xhat
    assert (abs(plain - without) / size).max() > 1e-6  # the step matters


def test_plants_that_differ_by_a_torque_per_row_share_a_library():
    made = [plant_library(stepping(np.full(n, 5.0 * n)), "ekf") for n in (1, 2, 3)]
    assert len({one.code for one in made if isinstance(one, PlantLibrary)}) == 1
    assert len(made) == 3


def test_an_augmented_plant_agrees():
    system = augmented(InductionMotor(), {"R_s": Unknown(0.18, 0.01)})
    made = plant_library(system, "ekf")
    assert isinstance(made, PlantLibrary), made
    assert agrees(system, made.code, made.numbers)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stiff": True}, "it is stiff"),
        ({"flow": lambda self, t0, t1, x, u: x}, "it moves by a flow of its own"),
        ({"output_residual": lambda self, y, yhat: y - yhat}, "it defines output_residual"),
    ],
)
def test_what_a_plant_is_makes_no_noise(changes, reason, caplog):
    system = type("Special", (ReverseDuffing,), changes)()
    assert plant_library(system, "ekf") == why_not(system, "ekf") == reason
    assert not caplog.records


def test_what_cannot_be_traced_is_said_once(caplog):
    say_once.cache_clear()

    class Untraced(Base):
        def force(self, t, a):
            return -np.interp(a, [-1.0, 0.0, 1.0], [-2.0, 0.0, 1.0])

    for _ in range(2):
        reason = plant_library(Untraced(), "ekf")
    assert reason.startswith("its equations cannot be traced: ")
    assert "\n" not in reason
    assert why_not(Untraced(), "ekf") == reason
    (line,) = [record.getMessage() for record in caplog.records]
    assert line == f"Untraced is computed in NumPy, which takes longer: {reason}"


def test_kernels_can_be_turned_off(monkeypatch):
    monkeypatch.setenv("PINNOBS_KERNELS", "0")
    reason = "kernels are turned off by PINNOBS_KERNELS=0"
    assert plant_library(ReverseDuffing(), "ekf") == why_not(ReverseDuffing(), "ekf") == reason
    monkeypatch.setenv("PINNOBS_KERNELS", "1")
    assert isinstance(plant_library(ReverseDuffing(), "ekf"), PlantLibrary)


HELPER = "GAIN = {gain}\n"
PLANT = """
from dataclasses import dataclass
import indexed_helper
from pinnobs_gym import Setup, System, stack
@dataclass(frozen=True)
class Plant(System):
    k: float = 1.0
    state_names, output_names, scale = ("a",), ("y",), (1.0,)
    setups = {{"benchmark": Setup((-1.0,), (1.0,), duration=1.0, dt=0.1)}}
    def f(self, t, x, u):
        return stack(x, {sign}self.k * indexed_helper.GAIN * x[..., 0])
    def h(self, t, x, u):
        return x
"""
PRINTS = """
import sys
import numpy as np
from indexed_plant import Plant
from pinnobs_gym.simulation.kernels.agreement import evaluated
from pinnobs_gym.simulation.kernels.plant_library import plant_library
plant = Plant(k=3.0)
made = plant_library(plant, "ekf")
x = np.ones((1, 1))
f = evaluated(plant, made.code, made.numbers, np.zeros(1), x, np.zeros((1, 0)))[0]
print(f.item(), "sympy" in sys.modules)
"""


def test_a_plant_is_found_again_without_sympy_unless_it_was_edited(own_folder, tmp_path):
    folder = tmp_path / "modules"
    folder.mkdir()
    path = os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])

    def printed(gain="2.0", sign="-"):
        (folder / "indexed_helper.py").write_text(HELPER.format(gain=gain))
        (folder / "indexed_plant.py").write_text(PLANT.format(sign=sign))
        return output_of(in_process(PRINTS, PYTHONPATH=path, PYTHONDONTWRITEBYTECODE="1"))

    assert printed() == "-6.0 True"
    assert printed() == "-6.0 False"
    assert printed(gain="5.0") == "-15.0 True"
    assert printed(sign="+") == "6.0 True"
    assert len(list(own_folder.glob("*.plant"))) == 3


def many_outputs(ny):
    """A plant whose outputs are sums of its states."""

    @dataclass(frozen=True)
    class Seen(Base):
        output_names = tuple(f"y{i}" for i in range(ny))

        def force(self, t, a):
            return -self.k * a

        def h(self, t, x, u):
            return stack(x, *(x[..., 0] + i * x[..., 1] for i in range(ny)))

    return Seen()


def test_code_of_many_outputs_is_short():
    """Straight-line code grows with the square of their number, for minutes of a compiler."""
    few, many = (plant_code(plant_form(many_outputs(ny))) for ny in (12, 25))
    assert "STRAIGHT" in few.once
    assert not many.steps


def test_plants_of_too_many_outputs_stay_in_numpy():
    assert why_not(many_outputs(33), "ekf") == "it has 33 outputs, more than 32"
    estimator = EKF(many_outputs(33))
    assert estimator.compiled is None
    assert why_not(many_outputs(32), "ekf") == ""
