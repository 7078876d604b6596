"""Equations that are not finite, or too steep, at the bounds of states are told."""

import re
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pinnobs_gym.simulation.at_bounds import faults_at_bounds
from pinnobs_gym.simulation.checks import SYSTEM_CHECKS
from pinnobs_gym.simulation.conformance import CheckFailed
from pinnobs_gym.simulation.notices import say_once
from pinnobs_gym.simulation.probe import probe
from pinnobs_gym.simulation.system import Setup, System


def tank(outflow, measured=lambda x: x, low=(0.0,), high=None, **changes):
    """A vessel with an outflow, as a function of its level x."""
    setup = replace(Setup((0.5,), (1.0,), duration=5, dt=0.1, noise_std=0.01), **changes)
    attributes = {
        "state_names": ("level",),
        "output_names": ("y",),
        "scale": (1.0,),
        "state_low": low,
        "state_high": high,
        "setups": {"benchmark": setup},
        "f": lambda self, t, x, u: -outflow(x),
        "h": lambda self, t, x, u: measured(x),
        "__annotations__": {},
    }
    return dataclass(frozen=True)(type("Tank", (System,), attributes))


def faults(cls):
    return faults_at_bounds(*cls.configured())


def test_smooth_equations_have_none():
    assert faults(tank(lambda x: x)) == []
    assert faults(tank(lambda x: np.sqrt(np.maximum(x, 1e-4)))) == []
    assert faults(tank(lambda x: x * x / (0.1 + x), np.exp, high=(2.0,))) == []
    assert faults(tank(np.sqrt, low=None)) == []  # without bounds


@pytest.mark.parametrize(
    ("cls", "says"),
    [
        (tank(np.sqrt), r"Tank\.f is at least 2000 times as steep in level at state_low=0 as"),
        (tank(lambda x: np.sqrt(np.clip(x, 0, None))), r"Tank\.f is at least 2000 times as steep"),
        (tank(lambda x: np.sqrt(2 - x), high=(2.0,)), r"Tank\.f .* at state_high=2 as"),
        (tank(lambda x: x, np.sqrt), r"Tank\.h is at least .* times as steep in level"),
        (tank(lambda x: x, np.log), r"Tank\.h is not finite at level=0, within its bounds"),
        (tank(lambda x: 1 / (x - 1), high=(2.0,)), r"Tank\.f is not finite at level=1, within"),
        (tank(lambda x: np.sqrt(x - 0.1)), r"Tank\.f is not finite at level=0, within its bounds"),
    ],
)
def test_each_fault_is_one_line_in_the_log_and_a_warning_of_check_system(cls, says, caplog):
    say_once.cache_clear()
    probe.__wrapped__(cls)
    probe.__wrapped__(cls)
    (record,) = caplog.records
    assert re.match(says, record.getMessage())
    with (
        pytest.warns(UserWarning, match=f"^system Tank, setup 'benchmark': {says}"),
        suppress(CheckFailed),  # the truth may leave the numbers, too
    ):
        SYSTEM_CHECKS["bounds"](cls)


def test_a_fault_counts_in_relation_to_the_sample_time():
    """A slope that changes nothing over a sample does no harm."""
    assert faults(tank(lambda x: 1e-6 * np.sqrt(x))) == []
