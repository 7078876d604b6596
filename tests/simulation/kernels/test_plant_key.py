"""The key of a plant's code: whatever changes its equations changes the key."""

import importlib
import importlib.util
import itertools
import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from pinnobs_gym import Unknown, augmented
from pinnobs_gym.simulation.kernels.plant_key import plant_key
from pinnobs_gym.simulation.plant_form import plant_form
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.induction_motor import InductionMotor
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

HELPER = """
import numpy as np
EXPONENT = {exponent}
def force(x):
    return -x**EXPONENT
"""
PLANT = """
from dataclasses import dataclass, field
from functools import lru_cache
import numpy as np
import {helper}
from pinnobs_gym import Setup, System, stack
GAIN = {gain}  # {comment}
@dataclass(frozen=True)
class Plant(System):
    k: float = 1.0
    mode: str = "a"
    curve: object = None
    state_names, output_names, scale, factor = ("a",), ("y",), (1.0,), 2.0
    setups = {{"benchmark": Setup((-1.0,), (1.0,), duration=1.0, dt=0.1)}}
    def f(self, t, x, u):
        return stack(x, self.k * GAIN * {helper}.force(x[..., 0]))
    def h(self, t, x, u):
        return x
"""
PLAIN = {"exponent": "3", "gain": "2.0", "comment": "a comment"}


@pytest.fixture
def load(tmp_path, monkeypatch):
    """Writes the modules of a plant, and imports them."""
    monkeypatch.syspath_prepend(tmp_path)
    before, times = set(sys.modules), itertools.count(10**9, 10)

    def write(**changes):
        texts = {**PLAIN, "helper": "key_helper", **changes}
        for name, text in (("key_helper", HELPER), ("key_plant", PLANT)):
            path = tmp_path / f"{name}.py"
            path.write_text(text.format(**texts))
            os.utime(path, (next(times),) * 2)

    def imported(**changes):
        write(**changes)
        for name in set(sys.modules) - before:
            if name.startswith("key_"):
                del sys.modules[name]
        importlib.invalidate_caches()
        return importlib.import_module("key_plant")

    imported.write = write
    yield imported
    for name in ("key_plant", "key_helper"):
        sys.modules.pop(name, None)


def key(system, *values):
    return plant_key(plant_form(system), *values)


def test_what_changes_it(load):
    keys = {key(load().Plant(), "ekf"), key(load().Plant(), "ukf")}
    for changes in ({"exponent": "5"}, {"gain": "3.0"}):
        keys.add(key(load(**changes).Plant(), "ekf"))
    plant = load().Plant()
    keys.add(key(replace(plant, mode="b"), "ekf"))
    keys.add(key(replace(plant, curve=np.arange(3.0)), "ekf"))
    keys.add(key(replace(plant, curve=(1.0, 2.0)), "ekf"))
    keys.add(key(replace(plant, k=math.inf), "ekf"))
    assert None not in keys
    assert len(keys) == 8


def test_what_does_not_change_it(load):
    plant = load().Plant()
    keys = {key(plant), key(replace(plant, k=3.0)), key(replace(plant, k=np.array([1.0, 2.0])))}
    keys |= {key(replace(plant, measured_input=True)), key(load(comment="another").Plant())}
    assert len(keys) == 1


def test_what_was_loaded_counts_beside_what_is_in_the_file(load):
    """A file that is edited after it was loaded must not give its key to the old code."""
    before = key(load().Plant())
    for changes in ({"gain": "3.0"}, {"exponent": "5"}):
        old = load().Plant
        load.write(**changes)
        mixed = key(old())
        assert len({before, mixed, key(load(**changes).Plant())}) == 3


def test_values_that_are_changed_while_it_runs_count(load):
    module = load()
    helper = sys.modules["key_helper"]
    keys = [key(module.Plant())]
    module.GAIN = 5.0
    keys.append(key(module.Plant()))
    helper.EXPONENT = 7
    keys.append(key(module.Plant()))
    module.Plant.factor = 3.0
    keys.append(key(module.Plant()))
    module.Plant.f = module.Plant.h
    keys.append(key(module.Plant()))
    assert None not in keys
    assert len(set(keys)) == len(keys)


def test_code_that_cannot_be_told_has_no_key(load, tmp_path):
    module = load()

    class Local(module.Plant):
        pass

    assert key(Local()) is None
    assert key(module.Plant(curve=object())) is None
    assert key(module.Plant(curve=lambda x: x)) is None
    factor = 2.0
    module.Plant.h = lambda self, t, x, u: factor * x
    assert key(module.Plant()) is None
    scope = {"__name__": "key_plant"}
    exec(PLANT.format(**PLAIN, helper="key_helper"), scope)
    assert key(scope["Plant"]()) is None


def test_every_system_of_the_package_has_one():
    keys = {name: key(cls()) for name, cls in SYSTEMS.classes().items()}
    assert None not in keys.values()
    assert len(set(keys.values())) == len(keys)


def test_other_plants_in_a_field_count():
    unknown = {"alpha": Unknown(0.05, 0.01)} if "alpha" in ReverseDuffing().parameters else None
    first = next(iter(InductionMotor().parameters))
    systems = [
        augmented(InductionMotor(), {first: Unknown(0.18, 0.01)}),
        augmented(InductionMotor(), {first: Unknown(0.18, 0.02)}),
        augmented(InductionMotor(T_L=3.0), {first: Unknown(0.18, 0.01)}),
    ]
    if unknown:
        systems.append(augmented(ReverseDuffing(), unknown))
    keys = [key(system) for system in systems]
    assert len(set(keys)) == len(keys) or None in keys
