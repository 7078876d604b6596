"""What is no number, no seed, no action, or absurdly large is refused in one line."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from made_envs import DUFFING, MOTOR, make, make_vec, short

from pinnobs_gym.envs.arguments import NOT_FINITE_REWARD
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.vector_env import EstimationVectorEnv

SHORT = short("ReverseDuffing")


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"stack_outputs": 10**9}, "stack_outputs=1000000000; expected a whole number from 1 to "),
        ({"stack_outputs": True}, "stack_outputs=True; expected a whole number"),
        ({"duration": 1e12}, "duration=1e+12 s has 5e+13 samples of dt=0.02 s; expected at most"),
        ({"duration": "5"}, "duration='5' s; expected a positive number"),
        ({"dt": 1e-9, "duration": 20.0}, "has 2e+10 samples"),
        ({"noise_std": "1"}, "noise_std='1'; expected numbers of at least 0"),
        ({"parameters": 3}, "parameters=3; expected values by name"),
        ({"action_mode": [1]}, "unknown action_mode [1]; known are estimate"),
        ({"setup": ["benchmark"]}, "unknown setup ['benchmark'] of ReverseDuffing"),
        ({"condition": 3}, "unknown condition 3; known are nominal"),
    ],
)
def test_arguments(arguments: dict[str, Any], says: str) -> None:
    for build in (lambda: make(DUFFING, **arguments), lambda: make_vec(DUFFING, 2, **arguments)):
        with pytest.raises(ValueError, match=re.escape(says)):
            build()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), "1", 1j, True])
def test_parameters(value: Any) -> None:
    with pytest.raises(ValueError, match=r"R_s=.* of InductionMotor; expected a finite number"):
        make(MOTOR, parameters={"R_s": value})


@pytest.mark.parametrize(
    ("num_envs", "says"),
    [
        (2**70, "1180591620717411303424 episodes of 1001 samples at a time are 3.55e+24 numbers"),
        (10**9, "expected at most 1e+09"),
        (2.5, "num_envs=2.5; expected a whole number of at least 1"),
        ("3", "num_envs='3'; expected a whole number"),
        (True, "num_envs=True; expected a whole number"),
    ],
)
def test_numbers_of_envs(num_envs: Any, says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(says)):
        EstimationVectorEnv(num_envs, "ReverseDuffing")


@pytest.mark.parametrize("name", ["x0", "xhat0"])
@pytest.mark.parametrize(
    ("value", "says"),
    [
        ([1e300, 0.0], "=[1e+300, 0.0]; expected x1 of at most 220000"),
        ("ab", " holds values of type <U2, such as 'ab'; expected real numbers"),
        ([1j, 0], " holds values of type complex128"),
        ([[1, 2], [3]], "=[[1, 2], [3]]; expected an array of real numbers"),
        ([10**400, 0], " holds values of type object"),
    ],
)
def test_states_of_a_reset(name: str, value: Any, says: str) -> None:
    with pytest.raises(ValueError, match=re.escape(name + says)):
        make(DUFFING, **SHORT).reset(options={name: value})


def test_a_refused_reset_changes_nothing() -> None:
    env, other = (make(DUFFING, **SHORT) for _ in range(2))
    for each in (env, other):
        each.reset(seed=1)
    with pytest.raises(ValueError, match="expected x1 of at most"):
        env.reset(seed=7, options={"x0": [1e300, 0.0]})
    assert env.reset()[0].tolist() == other.reset()[0].tolist()


@pytest.mark.parametrize("seed", [-1, 1.5, "3", float("nan"), True])
def test_seeds(seed: Any) -> None:
    says = re.escape(f"seed={seed!r}; expected a whole number of at least 0")
    for env in (make(DUFFING, **SHORT).unwrapped, make_vec(DUFFING, 2, **SHORT)):
        with pytest.raises(ValueError, match=says):
            env.reset(seed=seed)
    with pytest.raises(ValueError, match=says):
        make_vec(DUFFING, 2, **SHORT).reset(seed=[1, seed])
    with pytest.raises(ValueError, match=says):
        Game.of("ReverseDuffing", **SHORT).episodes([seed])


def test_masks_and_options() -> None:
    envs = make_vec(DUFFING, 2, **SHORT)
    with pytest.raises(ValueError, match="selects no row; expected at least one"):
        envs.reset(options={"reset_mask": [False, False]})
    with pytest.raises(ValueError, match=r"options=\['x0'\]; expected a dictionary"):
        envs.reset(options=["x0"])


@pytest.mark.parametrize("mode", ["estimate", "gain"])
@pytest.mark.parametrize(
    "action",
    ["ab", ["1", "2"], [1j, 0], np.array([1 + 1j, 0]), None, [10**400, 0], [[1, 2], [3]]],
)
def test_actions(mode: str, action: Any) -> None:
    env = make(DUFFING, action_mode=mode, **SHORT).unwrapped
    envs = make_vec(DUFFING, 2, action_mode=mode, **SHORT)
    for each, given in ((env, action), (envs, [action, action])):
        each.reset(seed=0)
        with pytest.raises(ValueError, match=r"^action.*expected .*real numbers"):
            each.step(given)
        each.step(each.action_space.sample())  # the episode goes on


@pytest.mark.parametrize("mode", ["estimate", "normalized", "gain", "correction"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_action_that_is_not_finite_ends_the_episode_in_every_form(
    mode: str, value: float
) -> None:
    envs = make_vec(DUFFING, 2, action_mode=mode, **SHORT)
    envs.reset(seed=0)
    _, rewards, terminated, _, _ = envs.step(np.array([[value, 0.0], [0.0, 0.0]]))
    assert terminated.tolist() == [True, False]
    assert rewards[0] == NOT_FINITE_REWARD < rewards[1]


def test_episodes_of_a_game() -> None:
    game = Game.of("ReverseDuffing", **SHORT)
    with pytest.raises(ValueError, match=r"episodes of 13 samples at a time .* expected at most"):
        game.episodes(range(10**10))
    with pytest.raises(ValueError, match=r"x0 has shape \(3, 7\); expected \(2,\)"):
        game.episodes([1], np.zeros((3, 7)))
    with pytest.raises(ValueError, match="is not finite"):
        game.episodes([1], np.array([[np.nan, 0.0]]))
    assert game.episodes([1, 2], np.array([0.5, 0.0])).x[0].tolist() == [[0.5, 0.0]] * 2
