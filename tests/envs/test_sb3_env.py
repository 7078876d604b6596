"""Our vector env as SB3's VecEnv: held to SB3's own DummyVecEnv of single envs."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from made_envs import DUFFING, make, make_vec, short
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from pinnobs_gym.envs.sb3_env import Sb3VecEnv


def pair(rows: int = 3, **arguments):
    arguments = {**short("ReverseDuffing", 9), "action_mode": "gain", **arguments}
    own = Sb3VecEnv(make_vec(DUFFING, rows, **arguments).unwrapped)
    peer = DummyVecEnv([lambda: make(DUFFING, **arguments) for _ in range(rows)])
    for env in (own, peer):
        env.seed(40)
    return own, peer


@pytest.mark.parametrize("mode", ["estimate", "gain"])
def test_it_steps_as_single_envs_do(mode: str) -> None:
    """Observations, rewards, ends, terminal observations and time limits, over several episodes,
    with actions among them that are not finite."""
    own, peer = pair(action_mode=mode)
    assert own.action_space == peer.action_space
    assert own.observation_space == peer.observation_space
    np.testing.assert_allclose(own.reset(), peer.reset(), rtol=1e-6)
    rng = np.random.default_rng(0)
    ends = []
    for _ in range(50):
        actions = 0.3 * rng.standard_normal((3, 2)).astype(np.float32)
        actions[rng.random(3) < 0.05] = np.nan
        mine, theirs = own.step(actions), peer.step(actions)
        for found, expected in zip(mine[:3], theirs[:3], strict=True):
            assert found.dtype == expected.dtype
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
        for found, expected in zip(mine[3], theirs[3], strict=True):
            assert found.get("TimeLimit.truncated", False) == expected["TimeLimit.truncated"]
            assert ("terminal_observation" in found) == ("terminal_observation" in expected)
            if "terminal_observation" in found:
                last = found["terminal_observation"], expected["terminal_observation"]
                np.testing.assert_allclose(*last, rtol=1e-4, atol=1e-5)
                ends.append(found["TimeLimit.truncated"])
            assert "state" not in found
    assert {True, False} == set(ends)


def test_seeds() -> None:
    own, _ = pair()
    first = own.reset()
    assert not np.array_equal(own.reset(), first)  # seeds are used once
    own.seed(40)
    assert np.array_equal(own.reset(), first)
    own.seed(41)
    assert np.array_equal(own.reset()[:2], first[1:])


def test_options_attributes_and_methods() -> None:
    own, _ = pair()
    own.set_options({"xhat0": [0.5, -0.5]})
    assert own.reset()[:, 1:3] == pytest.approx(np.tile([0.5 / 1.3, -0.5], (3, 1)))
    assert own.get_attr("num_envs", indices=[0, 2]) == [3, 3]
    assert len(own.env_method("record")) == 3
    assert own.env_is_wrapped(gymnasium.Wrapper) == [False] * 3
    own.set_attr("render_mode", None)
    with pytest.raises(ValueError, match="all rows at once"):
        own.set_attr("render_mode", None, indices=[0])
    own.set_options([{"xhat0": [0.5, -0.5]}, {}, {}])
    with pytest.raises(ValueError, match="options differ between rows"):
        own.reset()
    own.close()


def test_spread_rows_hold_samples_of_all_times() -> None:
    """Afterwards they are as far apart as they can be, those of even number play to the end, and
    those of odd number leave early every time."""
    own = Sb3VecEnv(make_vec(DUFFING, 8, **short("ReverseDuffing", 64)).unwrapped, spread=True)
    own.reset()
    ends = np.array([own.step(np.zeros((8, 2)))[2] for _ in range(512)])
    for row in range(8):
        steps = np.diff(np.flatnonzero(ends[:, row]), prepend=-1)
        part = (row + 1) / 8
        if row % 2:
            assert set(steps) == {64 * part**2}
        else:
            assert steps[0] == 64 * part
            assert set(steps[1:]) == {64}


def test_workers_find_the_env_by_its_module() -> None:
    """In a process that starts with nothing imported."""

    def build() -> gymnasium.Env:
        import gymnasium

        return gymnasium.make("pinnobs_gym:pinnobs/ReverseDuffing-v0", action_mode="gain")

    workers = SubprocVecEnv([build] * 2, start_method="spawn")
    try:
        workers.seed(0)
        assert workers.reset().shape == (2, 4)
    finally:
        workers.close()
