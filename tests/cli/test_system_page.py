"""The page of a system."""

import re
from dataclasses import dataclass, replace

import numpy as np
from angles import Compass

from pinnobs_gym.cli.system_page import page
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.systems.satellite import Satellite


@dataclass(frozen=True)
class Jar(System):
    """A level that is measured, and what is painted on the jar."""

    state_names = ("level", "label")
    output_names = ("y",)
    units = {"level": "m"}
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            (0, 0), (1, 1), duration=1.0, dt=0.1, noise_std=0.01, process_noise=(0.1, 0.0)
        )
    }

    def f(self, t, x, u):
        return stack(x, 0.0, 0.0)

    def h(self, t, x, u):
        return x[..., :1]


class Draughts(Jar):
    """A jar counted in steps, with an equation that branches."""

    discrete = True
    setups = {"benchmark": replace(Jar.setups["benchmark"], duration=10, dt=1)}

    def f(self, t, x, u):
        return x if float(np.sum(x)) < 1e9 else 2 * x

    def h_jacobian(self, t, x, u):
        return np.ones((*x.shape[:-1], 1, 1)) * [1.0, 0.0]


def test_the_page_says_which_states_and_outputs_repeat():
    text = page(Compass, "pinnobs/Compass-v0")
    for name in ("heading", "compass"):
        assert text.count(f"`{name}` repeats every 6.28319 rad: whole periods do not count.") == 1
    assert "repeats" not in page(Satellite, "pinnobs/Satellite-v0")


def test_the_page_says_what_the_outputs_tell():
    """Ten samples with noise 0.01: of 1/√12 = 0.289 the mean of ten leaves 0.00316."""
    text = page(Jar, "pinnobs/Jar-v0")
    assert "| level | m | 0.289 | 0.00316 (1.1 %) |" in text
    assert "| label |  | 0.289 | 0.289 (100 %) |" in text
    assert "has rank 1 of 2 in scaled states. The outputs never see `label`." in text
    assert "process noise [0.1, 0.0] per √s" in text


def test_the_page_says_what_is_hardly_seen():
    """Noise of ten times the prior: ten samples leave more than half of the variance."""

    class Dim(Jar):
        setups = {"benchmark": replace(Jar.setups["benchmark"], noise_std=3.0)}

    text = page(Dim, "pinnobs/Dim-v0")
    assert "The outputs never see `label`. The outputs tell less than the prior of `level`." in text


def test_the_page_says_where_jacobians_come_from():
    assert "f and h can be traced: their Jacobians are derived" in page(Jar, "pinnobs/Jar-v0")
    assert "The Jacobians of f and h are written by hand." in page(
        Satellite, "pinnobs/Satellite-v0"
    )
    text = page(Draughts, "pinnobs/Draughts-v0")
    assert "The Jacobian of f is found by finite differences, because it cannot be traced (" in text
    assert "; that of h is written by hand." in text
    assert "process noise [0.1, 0.0] per step" in text


def test_the_unit_of_time_of_a_map_is_the_step():
    """Whatever the page says of time; seconds stay those of a plant in continuous time."""
    text = page(Draughts, "pinnobs/Draughts-v0")
    assert "Truncated after 10 actions, 10 steps at 1 step in the `benchmark` setup" in text
    seconds = re.findall(r"[\d.]+ s\b[^|]*", text)
    assert seconds == ["1 s (of a map: as many steps), at most 20 % of the time "]
    assert "√s" not in text
    assert "10 actions, 1 s at 0.1 s in" in page(Jar, "pinnobs/Jar-v0")
