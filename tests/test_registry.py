import re
import sys
import typing
from typing import ClassVar, Generic, TypeVar

import gymnasium as gym
import numpy as np
import pytest

import pinnobs_gym
from pinnobs_gym import Setup, System
from pinnobs_gym.envs import registration
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import Registry
from pinnobs_gym.systems import SYSTEMS

PLUG_IN = '''
from pinnobs_gym import Estimator, Setup, State, System, stack


class Decay(System):
    """x' = -x."""

    state_names = ("x",)
    output_names = ("y",)
    scale = (1.0,)
    setups = {"benchmark": Setup((-1.0,), (1.0,), duration=1.0, dt=0.1)}

    def f(self, t, x, u):
        return stack(x, -x[..., 0])

    def h(self, t, x, u):
        return x


class Mirror(Estimator):
    """Takes the output for the state."""

    name = "mirror"

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        return State(y, t=t)
'''


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    (tmp_path / "plug_in_module.py").write_text(PLUG_IN)
    monkeypatch.syspath_prepend(tmp_path)
    return "plug_in_module"


def test_a_system_and_an_estimator_by_path(plug_in):
    env_id = registration.env_id(f"{plug_in}:Decay")
    assert env_id == "pinnobs/Decay-v0"
    rows = pinnobs_gym.evaluate(f"{plug_in}:Mirror", env_id, episodes=2)
    assert [row["rmse"] for row in rows] == [0, 0]  # measured without noise
    ekf = pinnobs_gym.evaluate("ekf", env_id, episodes=2)
    assert max(row["nrmse_tail"] for row in ekf) < 1e-3


def test_entry_points_are_found_and_broken_ones_left_out(plug_in, tmp_path, monkeypatch):
    info = tmp_path / "plug_in-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plug-in\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        f"[pinnobs_gym.systems]\nDecay = {plug_in}:Decay\nbroken = {plug_in}:Nothing\n"
    )
    fresh: Registry[System] = made("pinnobs_gym.systems")
    with pytest.warns(UserWarning, match="system plug-in 'broken' is left out"):
        classes = fresh.classes()
    assert "Decay" in classes
    assert "ReverseDuffing" in classes


def test_a_plug_in_that_is_named_is_loaded_alone(tmp_path, monkeypatch):
    """One whose class has another name than its entry point is found, too, after a warning of what
    cannot be imported before it."""
    info = tmp_path / "plug_in-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: plug-in\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        "[pinnobs_gym.systems]\n"
        "broken = broken_plug_in:Nothing\nDecay = one_plug_in:Decay\nz = other_plug_in:Growth\n"
    )
    (tmp_path / "broken_plug_in.py").write_text("raise RuntimeError('imported')")
    (tmp_path / "one_plug_in.py").write_text(PLUG_IN)
    (tmp_path / "other_plug_in.py").write_text(PLUG_IN.replace("Decay", "Growth"))
    monkeypatch.syspath_prepend(tmp_path)
    fresh = made("pinnobs_gym.systems")
    assert fresh.resolve("Decay").__module__ == "one_plug_in"
    assert not {"broken_plug_in", "other_plug_in"} & set(sys.modules)
    with pytest.warns(UserWarning, match="plug-in 'broken' is left out: RuntimeError: imported"):
        assert fresh.resolve("Growth").__module__ == "other_plug_in"
    for name in ("one_plug_in", "other_plug_in"):
        del sys.modules[name]


def made(package: str) -> Registry[System]:
    """A registry of systems whose files lie in a package."""
    return Registry("system", "pinnobs_gym.simulation.system:System", package, "state_names")


ZOO = {
    "__init__": "",
    "first": PLUG_IN
    + """

class Second(Decay):
    name = "another name"
    state_names = ("z",)
    version = 3


class Helper:
    name = "no system"
    state_names = ()
""",
    "broken": "raise RuntimeError('imported')\n\nclass Broken:\n    state_names = ()\n",
}


@pytest.fixture
def zoo(tmp_path, monkeypatch):
    folder = tmp_path / "zoo_package"
    folder.mkdir()
    for name, text in ZOO.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    yield made("zoo_package")
    for name in [name for name in sys.modules if name.startswith("zoo_package")]:
        del sys.modules[name]


def test_names_are_read_without_importing_and_resolved_alone(zoo):
    assert list(zoo.sources) == ["Broken", "Decay", "another name", "no system"]
    assert zoo.sources["another name"].constants["version"] == 3
    assert zoo.resolve("another name").state_names == ("z",)
    assert zoo.resolve("Decay").__name__ == "Decay"
    assert "zoo_package.broken" not in sys.modules
    message = "cannot load system 'Broken' from zoo_package.broken: RuntimeError: imported"
    with pytest.raises(ValueError, match=message):
        zoo.resolve("Broken")


def test_one_bad_file_harms_no_other(zoo, tmp_path):
    folder = tmp_path / "zoo_package"
    (folder / "half.py").write_text("x = 1\nclass Half(")
    (folder / "second.py").write_text(PLUG_IN)
    with pytest.warns(UserWarning, match="left out as a system") as caught:
        names = list(zoo.sources)
    assert names == ["Broken", "Decay", "another name", "no system"]
    told = [str(warning.message) for warning in caught]
    assert told == [
        "left out as a system: zoo_package.half, line 2, is no Python: '(' was never closed",
        "left out as a system: 'Decay' in zoo_package.second: zoo_package.first has one of that "
        "name",
    ]
    assert zoo.sources["Decay"].module == "zoo_package.first"
    with pytest.warns(UserWarning, match="cannot load system 'Broken' from zoo_package.broken"):
        assert "Decay" in zoo.classes()


def test_what_is_none_is_told_why():
    with pytest.raises(TypeError, match="Half lacks what a System has to define: f, h"):
        SYSTEMS.register(type("Half", (System,), {}))
    with pytest.raises(TypeError, match="'int'> is not a subclass of System"):
        SYSTEMS.register(int)  # pyright: ignore


def test_a_package_that_hides_ours_is_named(tmp_path, monkeypatch):
    (tmp_path / "hidden_zoo").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"unknown system 'A'; there is none in .*hidden_zoo"):
        made("hidden_zoo").resolve("A")


def test_what_a_registry_forgets(zoo):
    class Own(System):
        state_names = output_names = ("x",)
        scale = (1.0,)
        setups: ClassVar = {}

        def f(self, t, x, u):
            return -x

        def h(self, t, x, u):
            return x

    with zoo.isolated():
        zoo.register(Own)
        assert zoo.resolve("Own") is Own
        assert zoo.resolve(f"{Own.__module__}:{Own.__qualname__}") is Own  # of a function
    known = "Broken, Decay, another name, no system"
    with pytest.raises(ValueError, match=f"unknown system 'Own'; known are {known}"):
        zoo.resolve("Own")
    assert "zoo_package.broken" not in sys.modules


def test_unknown_names_list_the_known_ones():
    with pytest.raises(ValueError, match="unknown system 'Duffing'; known are Academic, Harm"):
        SYSTEMS.resolve("Duffing")
    with pytest.raises(ValueError, match=r"unknown estimator 'kf'; known are .*ekf, .*open_loop"):
        ESTIMATORS.resolve("kf")
    with pytest.raises(ValueError, match="cannot load system 'nowhere:X': ModuleNotFound"):
        SYSTEMS.resolve("nowhere:X")


@pytest.mark.parametrize(
    ("spec", "advice"),
    [
        ("efk", "did you mean 'ekf'?"),
        ("none of all these", "one of your own is given as module:Estimator"),
        ("pinnobs_gym.estimators.ekf:Ekf", "did you mean 'EKF'?"),
        ("pinnobs_gym.estimators.ekf:Mine", "it has EKF"),
        ("plug/mine.py:Mine", "a module is named without .py and with dots: plug.mine:Mine"),
    ],
)
def test_unknown_names_end_with_what_may_have_been_meant(spec, advice):
    with pytest.raises(ValueError, match=rf"; {re.escape(advice)}$"):
        ESTIMATORS.resolve(spec)


def test_what_lies_beside_a_class_is_not_looked_for_in_the_standard_library(monkeypatch):
    """Of the names of typing, some warn when they are looked at."""
    monkeypatch.setattr(typing, "looked_at", ESTIMATORS.resolve("ukf"), raising=False)

    class Own(Generic[TypeVar("T")]):
        pass

    assert "ukf" not in ESTIMATORS.beside(Own)


def test_register_refuses_what_is_incomplete_or_taken():
    class NoSetups(System):
        state_names = ("x",)
        output_names = ("y",)
        scale = (1.0,)

        def f(self, t, x, u):
            return -x

        def h(self, t, x, u):
            return x

    with pytest.raises(TypeError, match="NoSetups has no class attribute 'setups'"):
        pinnobs_gym.register(NoSetups)

    class OldOutput(NoSetups):
        setups = {"benchmark": Setup((0,), (1,), duration=1, dt=0.1)}

        def h(self, x):
            return x

    with pytest.raises(TypeError, match=r"OldOutput: h\(self, x\); expected h\(self, t, x, u\)"):
        pinnobs_gym.register(OldOutput)

    class WrongSize(NoSetups):
        setups = {"benchmark": Setup((0, 0), (1, 1), duration=1, dt=0.1)}

    with pytest.raises(TypeError, match=r"WrongSize: x0_low .* shape \(2,\); expected 1"):
        pinnobs_gym.register(WrongSize)
    with pytest.raises(TypeError, match="neither a System, an Estimator nor a Trainer"):
        pinnobs_gym.register(int)
    ReverseDuffing = type("ReverseDuffing", (NoSetups,), {"setups": WrongSize.setups})
    with pytest.raises(ValueError, match="'ReverseDuffing' is already"):
        SYSTEMS.register(ReverseDuffing)


def test_registering_twice_is_harmless():
    cls = SYSTEMS.resolve("Academic")
    assert pinnobs_gym.register(cls) is cls
    env = gym.make("pinnobs/Academic-v0")
    observation, _ = env.reset(seed=0)
    assert np.isfinite(observation).all()


def test_a_module_that_exits_is_one_line(tmp_path, monkeypatch):
    (tmp_path / "exiting_module.py").write_text("import sys\nsys.exit(0)\n")
    monkeypatch.syspath_prepend(tmp_path)
    line = r"cannot load system 'exiting_module:Plant': SystemExit: 0"
    with pytest.raises(ValueError, match=line):
        made("pinnobs_gym.systems").resolve("exiting_module:Plant")
