"""The page of a system."""

import re
from dataclasses import dataclass, replace

import numpy as np
from angles import Compass

from pinnobs_gym.cli import agent_section
from pinnobs_gym.cli.system_page import page
from pinnobs_gym.envs.actions import FORMS
from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.simulation.system import Setup, System, stack
from pinnobs_gym.systems.induction_motor import InductionMotor
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


def test_the_page_says_to_agents_what_the_envs_have():
    text = page(InductionMotor, "pinnobs/InductionMotor-v0")
    for mode in FORMS:
        (line,) = re.findall(rf"^\| `{mode}` \|.*\| (\d+) \| (\d+) \|$", text, re.M)
        env = EstimationEnv(InductionMotor, action_mode=mode)
        assert line == (str(env.action_space.shape[0]), str(env.observation_space.shape[0]))
    assert f"`reward_threshold` is {InductionMotor.reward_threshold}, the mean return" in text
    assert "No returns are published" in page(Jar, "pinnobs/Jar-v0")
    assert "reward_threshold" not in page(Jar, "pinnobs/Jar-v0")


def test_published_returns_are_those_of_the_published_episodes(monkeypatch):
    """Two episodes of ten samples with NRMSE 0.1 and 0.3: returns of −0.1 and −0.9."""
    rows = [
        {"estimator": name, "training_seed": seed, "nrmse": nrmse, "game_hash": "earlier"}
        for name, seed, values in (
            ("ekf", None, (0.1, 0.3)),
            ("sb3", 0, (1, 1)),
            ("sb3", 1, (0, 2)),
        )
        for nrmse in values
    ]
    monkeypatch.setattr(agent_section, "_published", lambda env_id: rows)
    text = page(Jar, "pinnobs/Jar-v0")
    assert "−10·NRMSE² each, without discount. They are of other code than the present." in text
    assert "| ekf | -0.5 | -0.5 | -0.9 | 2 |" in text
    assert "| sb3, the best of 2 in these episodes | -10 | -10 | -10 | 2 |" in text


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


@dataclass(frozen=True)
class Lidded(Jar):
    state_low = (0.0, None)
    state_high = (2.5, 1 / 3)
    setups = {
        "benchmark": replace(
            Jar.setups["benchmark"], x0_high=(1, 1 / 3), noise_std=1 / 3, process_noise=(2 / 3, 0.0)
        )
    }


def test_the_page_says_the_bounds_of_states_and_rounds_numbers():
    text = page(Lidded, "pinnobs/Lidded-v0")
    assert (
        "`level` is at least 0 m and at most 2.5 m; `label` is at most 0.333333: the plant and all "
        "estimates stay within these bounds." in text
    )
    assert "stay within these bounds" not in page(Jar, "pinnobs/Jar-v0")
    assert "output noise [0.333333]; process noise [0.666667, 0.0]" in text
    assert "x₀ uniform in [0.0, 0.0] to [1.0, 0.333333]" in text
    assert "P₀ = [[0.0833333, 0.0], [0.0, 0.00925926]]" in text
    assert not re.search(r"\d\.\d{9}", text)
