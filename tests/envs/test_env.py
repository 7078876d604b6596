"""The environments, through Gymnasium: what a user of them may rely on."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from linear import FeedThrough, Linear, Modulated
from made_envs import ALLOWED_WARNINGS, DUFFING, IDS, MOTOR, make, make_vec, short

from pinnobs_gym.envs.arguments import NOT_FINITE_REWARD
from pinnobs_gym.envs.env import EstimationEnv
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.figures import measured_states
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.simulated import simulate
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.system import output_scale
from pinnobs_gym.systems import SYSTEMS


def play(env: gymnasium.Env, seed: int | None = None, **kwargs: Any) -> dict[str, np.ndarray]:
    """A whole episode, with the true states as actions."""
    observation, info = env.reset(seed=seed, **kwargs)
    observations, states, rewards, over = [observation], [info["state"]], [], False
    while not over:
        observation, reward, terminated, over, info = env.step(states[-1])
        assert not terminated
        observations.append(observation)
        states.append(info["state"])
        rewards.append(reward)
    return {
        "observations": np.array(observations),
        "states": np.array(states),
        "rewards": np.array(rewards),
    }


# The interfaces


@pytest.mark.parametrize("name", IDS.values())
@pytest.mark.parametrize("checker", ["gymnasium", "stable_baselines3"])
def test_conforms(name: str, checker: str) -> None:
    env = make(name).unwrapped
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if checker == "gymnasium":
            check_env(env, skip_render_check=True)  # see the tests of rendering
        else:
            from stable_baselines3.common.env_checker import check_env as check_sb3

            check_sb3(env, skip_render_check=True)
    messages = [str(warning.message) for warning in caught]
    unexpected = [m for m in messages if not any(allowed in m for allowed in ALLOWED_WARNINGS)]
    assert not unexpected


@pytest.mark.skipif(sys.platform != "linux", reason="others always have a display")
def test_gymnasiums_checker_passes_without_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(gymnasium.make(DUFFING, duration=0.1).unwrapped)
    assert make(DUFFING).unwrapped.metadata["render_modes"] == ["rgb_array"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert make(DUFFING).unwrapped.metadata["render_modes"] == ["human", "rgb_array"]


@pytest.mark.parametrize(
    "name",
    [
        name if name == "ReverseDuffing" else pytest.param(name, marks=pytest.mark.slow)
        for name in IDS
    ],
)
def test_the_reward_threshold_is_the_mean_return_of_the_ukf(name: str) -> None:
    """By the env's own reward, in the episodes of seeds 0 to 99 of the vectorised env."""
    envs = make_vec(IDS[name], 100)
    source = envs.unwrapped.source
    record = Game.of(name).record(range(100))
    xhat = UKF.for_setup(source.system, source.setup).run(record).xhat
    envs.reset(seed=0)
    returns = sum(envs.step(xhat[:, k])[1] for k in range(source.setup.num_steps))
    threshold = gymnasium.spec(IDS[name]).reward_threshold
    assert threshold == pytest.approx(float(np.mean(returns)), rel=0.01)
    assert threshold == SYSTEMS.resolve(name).reward_threshold


def test_vector_env_is_gymnasiums() -> None:
    envs = make_vec(DUFFING, 3)
    assert isinstance(envs.unwrapped, EstimationVectorEnv)
    assert envs.observation_space.shape == (3, 2)
    assert envs.action_space.shape == (3, 2)
    observations, infos = envs.reset(seed=0)
    assert envs.observation_space.contains(observations)
    assert infos["state"].shape == (3, 2)
    step = envs.step(envs.action_space.sample())
    assert [part.shape for part in step[:4]] == [(3, 2), (3,), (3,), (3,)]
    envs.close()


def test_id_with_the_module_before_it() -> None:
    env = gymnasium.make("pinnobs_gym:pinnobs/Satellite-v0", disable_env_checker=True)
    assert isinstance(env.unwrapped, EstimationEnv)
    assert type(env.unwrapped.source.system).__name__ == "Satellite"


@pytest.mark.parametrize("name", IDS)
def test_spaces(name: str) -> None:
    env = make(IDS[name])
    system = SYSTEMS.resolve(name)()
    assert env.action_space.shape == (system.nx,)
    assert env.observation_space.shape == (system.ny + system.nu + 1,)
    assert env.observation_space.dtype == np.float32
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert env.action_space.contains(info["state"].astype(np.float32))


# Episodes


@pytest.mark.parametrize("name", IDS)
def test_same_seed_same_episode(name: str) -> None:
    first, second = (play(make(IDS[name], **short(name)), seed=3) for _ in range(2))
    other = play(make(IDS[name], **short(name)), seed=4)
    for key in first:
        assert np.array_equal(first[key], second[key])
    assert not np.array_equal(first["states"][0], other["states"][0])
    assert not np.array_equal(first["observations"], other["observations"])


def test_reseeding_begins_anew() -> None:
    env = make(DUFFING, **short("ReverseDuffing"))
    first, following = play(env, seed=3), play(env)
    assert not np.array_equal(first["states"], following["states"])
    assert np.array_equal(play(env, seed=3)["observations"], first["observations"])
    assert np.array_equal(play(env)["observations"], following["observations"])


def test_unseeded_envs_differ() -> None:
    a, b = (make(DUFFING).reset()[1]["state"] for _ in range(2))
    assert not np.array_equal(a, b)


@pytest.mark.parametrize(
    "condition",
    [
        "nominal",
        "dropout30+noise5",
        "mismatch30+outliers+delay2",
        "process_noise1e-2+gap+xhat0_far",
        "x0_outside+delay5",
    ],
)
@pytest.mark.parametrize("name", IDS)
def test_row_of_vector_env_is_the_single_env(name: str, condition: str) -> None:
    """Over several consecutive episodes: initial states to the bit, later states up to the rounding
    of matrix products in batches of another size, and observations up to single precision's."""
    arguments: dict[str, Any] = {**short(name), "condition": condition}
    envs = make_vec(IDS[name], 3, **arguments)
    singles = [make(IDS[name], **arguments) for _ in range(3)]
    observations, infos = envs.reset(seed=20)
    for episode in range(4):
        expected = [
            play(env, seed=20 + i if not episode else None) for i, env in enumerate(singles)
        ]
        for k in range(13):
            for i in range(3):
                states = infos["state"][i], expected[i]["states"][k]
                assert states[0] == pytest.approx(states[1], rel=1e-12, abs=1e-12)
                assert k or np.array_equal(*states)
                theirs = expected[i]["observations"][k]
                np.testing.assert_allclose(observations[i], theirs, rtol=1e-6, atol=1e-6)
            observations, rewards, _, truncated, infos = envs.step(infos["state"])
            assert (rewards == 0).all()
            assert truncated.all() == (k == 11)


@pytest.mark.parametrize("name", IDS)
def test_timing(name: str) -> None:
    env = make(IDS[name])
    setup = SYSTEMS.resolve(name).setups["benchmark"]
    steps = round(setup.duration / setup.dt)
    episode = play(env, seed=0)
    assert (episode["rewards"] == 0).all()  # action k is scored against x_k, exactly
    assert len(episode["rewards"]) == steps
    assert len(episode["observations"]) == steps + 1
    time = episode["observations"][:, -1]
    assert time == pytest.approx(np.arange(steps + 1) / steps, abs=1e-6)
    assert time[-1] == 1
    with pytest.raises(RuntimeError, match="reset"):
        env.unwrapped.step(episode["states"][-1])


@pytest.mark.parametrize("name", IDS)
def test_reward_formula(name: str) -> None:
    env, envs = make(IDS[name]), make_vec(IDS[name], 2)
    scale = np.array(SYSTEMS.resolve(name).scale)
    rng = np.random.default_rng(0)
    x = env.reset(seed=8)[1]["state"]
    xs = envs.reset(seed=8)[1]["state"]
    for _ in range(5):
        error = rng.standard_normal((2, len(scale))) * scale
        _, reward, _, _, info = env.step(x + error[0])
        _, rewards, _, _, infos = envs.step(xs + error)
        expected = -np.mean((error / scale) ** 2, axis=1)
        assert reward == pytest.approx(expected[0], rel=1e-9)
        assert isinstance(reward, float)
        assert rewards == pytest.approx(expected, rel=1e-9)
        x, xs = info["state"], infos["state"]


def test_actions_are_not_clipped() -> None:
    env = make(DUFFING)
    x = env.reset(seed=0)[1]["state"]
    assert env.step(x + np.array([1300.0, 0.0]))[1] == pytest.approx(-(1000.0**2) / 2, rel=1e-9)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_action_that_is_not_finite(value: float) -> None:
    env = make(DUFFING)
    x = env.reset(seed=0)[1]["state"]
    _, reward, terminated, truncated, _ = env.step(np.array([x[0], value]))
    assert (reward, terminated, truncated) == (NOT_FINITE_REWARD, True, False)
    with pytest.raises(RuntimeError, match="reset"):
        env.unwrapped.step(x)
    assert play(env)["rewards"].max() == 0  # the next episode is sound

    envs = make_vec(DUFFING, 3)
    actions = envs.reset(seed=0)[1]["state"]
    actions[1, 0] = value
    _, rewards, terminated, truncated, _ = envs.step(actions)
    assert rewards.tolist() == [0, NOT_FINITE_REWARD, 0]
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()


def test_huge_action_has_a_finite_reward() -> None:
    env, envs = make(DUFFING), make_vec(DUFFING, 2)
    env.reset(seed=0)
    actions = envs.reset(seed=0)[1]["state"]
    actions[0] = 1e300
    with np.errstate(over="ignore"):
        _, reward, terminated, _, _ = env.step(np.array([1e300, 0.0]))
        _, rewards, terminations, _, _ = envs.step(actions)
    assert np.isfinite(reward)
    assert reward < NOT_FINITE_REWARD
    assert not terminated
    assert np.isfinite(rewards).all()
    assert not terminations.any()
    assert rewards[1] == 0


class NextStep:
    """Gymnasium's NEXT_STEP autoreset written out, over one single env."""

    def __init__(self, seed: int, **kwargs: Any) -> None:
        self._env = make(DUFFING, **kwargs)
        self.observation, self.info = self._env.reset(seed=seed)
        self._over = False

    def step(self, action: np.ndarray) -> tuple[float, bool, bool]:
        if self._over:
            self.observation, self.info = self._env.reset()
            self._over = False
            return 0.0, False, False
        self.observation, reward, terminated, truncated, self.info = self._env.step(action)
        self._over = terminated or truncated
        return float(reward), terminated, truncated


def test_autoreset_with_rows_out_of_step() -> None:
    arguments = short("ReverseDuffing", 9)
    envs = make_vec(DUFFING, 4, **arguments)
    assert envs.metadata["autoreset_mode"] == gymnasium.vector.AutoresetMode.NEXT_STEP
    rows = [NextStep(50 + i, **arguments) for i in range(4)]
    observations, infos = envs.reset(seed=50)
    rng = np.random.default_rng(1)
    starts = np.zeros(4, dtype=int)
    for _ in range(60):
        actions = infos["state"] + 0.1 * rng.standard_normal((4, 2))
        actions[rng.random(4) < 0.1] = np.nan
        expected = [row.step(action) for row, action in zip(rows, actions, strict=True)]
        observations, rewards, terminated, truncated, infos = envs.step(actions)
        assert rewards == pytest.approx([e[0] for e in expected], rel=1e-9)
        assert terminated.tolist() == [e[1] for e in expected]
        assert truncated.tolist() == [e[2] for e in expected]
        expected = np.array([row.observation for row in rows])
        np.testing.assert_allclose(observations, expected, rtol=1e-6, atol=1e-6)
        states = np.array([row.info["state"] for row in rows])
        assert infos["state"] == pytest.approx(states, rel=1e-12, abs=1e-12)
        starts += observations[:, -1] == 0
    assert (starts >= 5).all()
    assert len(set(starts)) > 1  # the rows did go out of step


# Options


@pytest.mark.parametrize("name", IDS)
def test_option_x0(name: str) -> None:
    """The episode starts there, and follows the plant; the noise stays that of the seed."""
    env = make(IDS[name], **short(name))
    start = play(env, seed=1)["states"][0]
    x0 = play(env, seed=2)["states"][0]  # one of the set
    moved = play(env, seed=1, options={"x0": x0})
    assert np.array_equal(moved["states"][0], x0)
    assert not np.array_equal(start, x0)
    again = play(env, seed=2)
    assert moved["states"] == pytest.approx(again["states"], rel=1e-9, abs=1e-9)
    vector = make_vec(IDS[name], 2, **short(name))
    assert np.array_equal(vector.reset(seed=1, options={"x0": x0})[1]["state"], [x0, x0])
    both = np.array([start, x0])
    assert np.array_equal(vector.reset(seed=1, options={"x0": both})[1]["state"], both)


def test_x0_outside_the_set_warns() -> None:
    env, envs = make(DUFFING), make_vec(DUFFING, 2)
    with pytest.warns(UserWarning, match=r"x0=\[0.0, 0.1\] is outside the initial set of Reverse"):
        _, info = env.reset(seed=0, options={"x0": [0.0, 0.1]})
    assert info["state"].tolist() == [0.0, 0.1]
    with pytest.warns(UserWarning, match="outside the initial set"):
        envs.reset(seed=0, options={"x0": [[1.0, 1.0], [5.0, 0.0]]})
    env.reset(seed=0, options={"x0": [1.0, 1.0]})  # inside: no warning


def test_option_xhat0_and_the_prior() -> None:
    env, envs = make(DUFFING), make_vec(DUFFING, 2)
    _, info = env.reset(seed=0)
    assert info["xhat0"].tolist() == [0.0, 0.0]
    assert info["P0"].tolist() == [[1.682, 0.0], [0.0, 1.002]]
    _, moved = env.reset(seed=0, options={"xhat0": [0.5, -0.5]})
    assert moved["xhat0"].tolist() == [0.5, -0.5]
    assert np.array_equal(moved["state"], info["state"])
    _, infos = envs.reset(seed=0, options={"xhat0": [[0.5, -0.5], [0.0, 2.0]]})
    assert infos["xhat0"].tolist() == [[0.5, -0.5], [0.0, 2.0]]
    assert infos["P0"].shape == (2, 2, 2)


def test_option_reset_mask() -> None:
    envs = make_vec(DUFFING, 3, **short("ReverseDuffing"))
    twin = make_vec(DUFFING, 3, **short("ReverseDuffing"))
    for env in (envs, twin):
        env.reset(seed=0)
        for _ in range(4):
            env.step(np.zeros((3, 2)))
    before = twin.step(np.zeros((3, 2)))
    envs.step(np.zeros((3, 2)))
    observations, infos = envs.reset(options={"reset_mask": np.array([False, True, False])})
    assert np.array_equal(observations[[0, 2]], before[0][[0, 2]])
    assert np.array_equal(infos["state"][[0, 2]], before[4]["state"][[0, 2]])
    assert observations[:, -1] == pytest.approx([5 / 12, 0, 5 / 12])
    single = make(DUFFING, **short("ReverseDuffing"))
    single.reset(seed=1)
    assert np.array_equal(single.reset()[1]["state"], infos["state"][1])  # its second episode
    for k in range(6, 12):
        observations, _, _, truncated, _ = envs.step(np.zeros((3, 2)))
        assert observations[:, -1] == pytest.approx([k / 12, (k - 5) / 12, k / 12])
        assert not truncated.any()
    assert envs.step(np.zeros((3, 2)))[3].tolist() == [True, False, True]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"x1": 0}, "unknown reset option 'x1'; known are x0, xhat0"),
        ({"x0": [1.0]}, r"x0 has shape \(1,\); expected \(2,\)"),
        ({"x0": np.zeros((3, 2))}, r"x0 has shape \(3, 2\)"),
        ({"x0": [np.nan, 0.0]}, r"x0=\[nan, 0.0\] is not finite"),
        ({"xhat0": [1.0, 2.0, 3.0]}, r"xhat0 has shape \(3,\); expected \(2,\)"),
        ({"xhat0": [np.inf, 0.0]}, r"xhat0=\[inf, 0.0\] is not finite"),
    ],
)
def test_wrong_options(options: dict[str, Any], says: str) -> None:
    for env in (make(DUFFING), make_vec(DUFFING, 2)):
        with pytest.raises(ValueError, match=says):
            env.reset(seed=0, options=options)


def test_wrong_vector_options() -> None:
    envs = make_vec(DUFFING, 2)
    with pytest.raises(ValueError, match=r"reset_mask=\[True\]; expected 2 booleans"):
        envs.reset(options={"reset_mask": np.array([True])})
    with pytest.raises(ValueError, match=r"reset_mask=\[1, 0\]; expected 2 booleans"):
        envs.reset(options={"reset_mask": np.array([1, 0])})
    with pytest.raises(ValueError, match="3 seeds; expected 2"):
        envs.reset(seed=[1, 2, 3])
    with pytest.raises(ValueError, match="num_envs=0; expected at least 1"):
        EstimationVectorEnv(0, "ReverseDuffing")


def test_wrong_action_shapes() -> None:
    env, envs = make(DUFFING), make_vec(DUFFING, 2)
    env.reset(seed=0)
    envs.reset(seed=0)
    with pytest.raises(ValueError, match=r"action has shape \(3,\); expected \(2,\)"):
        env.step(np.zeros(3))
    with pytest.raises(ValueError, match=r"actions have shape \(2,\); expected \(2, 2\)"):
        envs.step(np.zeros(2))


def test_step_before_reset() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        EstimationEnv("ReverseDuffing").step(np.zeros(2))
    with pytest.raises(RuntimeError, match="reset"):
        EstimationVectorEnv(2, "ReverseDuffing").step(np.zeros((2, 2)))


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"system": "Nope"}, "unknown system 'Nope'; known are Academic, .*ReverseDuffing"),
        ({"setup": "nope"}, "unknown setup 'nope' of ReverseDuffing; it has benchmark, paper"),
        ({"condition": "nope"}, "unknown condition 'nope'; known are nominal, .*dropout30"),
        ({"condition": "noise5+nope"}, "unknown condition 'nope'; known are"),
        ({"condition": "load_step"}, "'load_step' needs .* ReverseDuffing has none"),
        ({"parameters": {"mass": 1}}, "unknown parameter 'mass' of ReverseDuffing; it has none"),
        ({"dt": 0}, "dt=0 s; expected a positive number"),
        ({"dt": -0.1}, "dt=-0.1 s; expected a positive number"),
        ({"dt": float("nan")}, "dt=nan s; expected a positive number"),
        ({"duration": 0.0}, "duration=0.0 s; expected a positive number"),
        ({"duration": 0.01}, "duration=0.01 s is shorter than one sample, dt=0.02 s"),
        ({"noise_std": -1.0}, "noise_std=-1.0; expected numbers of at least 0"),
        ({"noise_std": (0.1, 0.1)}, r"noise_std of ReverseDuffing has shape \(2,\); expected 1"),
        ({"render_mode": "ansi"}, "render_mode='ansi'; expected .*rgb_array"),
    ],
)
def test_wrong_arguments(arguments: dict[str, Any], says: str) -> None:
    given = {"system": "ReverseDuffing", **arguments}
    with pytest.raises(ValueError, match=says):
        EstimationEnv(**given)
    with pytest.raises(ValueError, match=says):
        EstimationVectorEnv(2, **given)


def test_wrong_argument_through_gymnasium() -> None:
    with pytest.raises(ValueError, match="unknown setup 'nope' of ReverseDuffing"):
        make(DUFFING, setup="nope")
    with pytest.raises(ValueError, match="unknown parameter 'mass' of InductionMotor; it has R_s"):
        make_vec(MOTOR, 2, parameters={"mass": 1.0})


def test_dt_and_duration_are_honoured() -> None:
    fine = play(make(DUFFING, dt=0.01, duration=0.5, noise_std=0), seed=0)
    coarse = play(make(DUFFING, dt=0.05, duration=1.02, noise_std=0), seed=0)
    assert len(fine["rewards"]) == 50
    assert len(coarse["rewards"]) == 20  # what is left of the duration is no sample
    assert fine["states"][::5] == pytest.approx(coarse["states"][:11], abs=1e-9)


def test_paper_setup() -> None:
    env = make(IDS["HarmonicOscillator"], setup="paper", duration=1.0)
    a, b = play(env, seed=0), play(env)
    assert a["states"][0].tolist() == [0.0, 1.0, 3.0]
    assert len(a["rewards"]) == 500
    assert np.array_equal(a["observations"], b["observations"])  # no noise, and a fixed start
    assert a["observations"][:, 0] == pytest.approx(a["states"][:, 0], abs=1e-6)


def test_parameters_are_honoured() -> None:
    heavy = play(make(MOTOR, parameters={"J": 1e6}, **short("InductionMotor", 200)), seed=0)
    light = play(make(MOTOR, **short("InductionMotor", 200)), seed=0)
    assert abs(np.diff(heavy["states"][:, 4])).max() < 1e-3
    assert abs(np.diff(light["states"][:, 4])).max() > 0.1


def errors(num_envs: int = 20, **kwargs: Any) -> np.ndarray:
    """y − h(x) of many episodes of the oscillator, (num_samples, num_envs); NaN if y is missing."""
    envs = make_vec(DUFFING, num_envs, **kwargs)
    observations, infos = envs.reset(seed=0)
    found, over = [], np.array([False])
    while True:
        assert envs.observation_space.contains(observations)
        present = observations[:, 1] == 1 if observations.shape[1] == 3 else np.full(num_envs, True)
        found.append(np.where(present, observations[:, 0] - infos["state"][:, 0], np.nan))
        if over.any():
            return np.array(found)
        observations, _, _, over, infos = envs.step(infos["state"])


@pytest.mark.parametrize(
    ("arguments", "std"),
    [
        ({}, 0.02),
        ({"noise_std": 0.5}, 0.5),
        ({"noise_std": 0.1, "condition": "noise5"}, 0.5),
        ({"condition": "noise15"}, 0.3),
        ({"condition": "noise0.1"}, 0.002),
    ],
)
def test_noise_level(arguments: dict[str, Any], std: float) -> None:
    noise = errors(**arguments)  # 20020 numbers: a standard error of 0.5 %
    assert noise.std() == pytest.approx(std, rel=0.025)
    assert abs(noise.mean()) < 0.04 * std
    lagged = (noise[1:] * noise[:-1]).mean() / std**2
    across = np.corrcoef(noise.T)[~np.eye(20, dtype=bool)]
    assert abs(lagged) < 0.035  # white
    assert abs(across.mean()) < 0.01  # and another one in every row


def test_no_noise() -> None:
    assert abs(errors(condition="noise0")).max() < 1e-6  # single precision


@pytest.mark.parametrize("percent", [10, 30, 50])
def test_dropouts(percent: int) -> None:
    found = errors(condition=f"dropout{percent}")
    missing = np.isnan(found)
    assert missing.mean() == pytest.approx(percent / 100, abs=0.015)
    assert missing.mean(axis=0) == pytest.approx(percent / 100, abs=0.08)  # in every row
    assert np.nanstd(found) == pytest.approx(0.02, rel=0.05)


def test_outliers() -> None:
    found = abs(errors(condition="outliers"))
    far = found > 10 * 0.02
    # 5 %, of which those within 10 of their 50 σ do not count
    assert far.mean() == pytest.approx(0.05 * 0.8415, abs=0.008)
    assert found[~far].std() < 0.04
    assert np.sqrt((found[far] ** 2).mean()) == pytest.approx(50 * 0.02, rel=0.2)


def test_conditions_combine() -> None:
    found = errors(condition="dropout30+noise15")
    assert np.isnan(found).mean() == pytest.approx(0.3, abs=0.015)
    assert np.nanstd(found) == pytest.approx(0.3, rel=0.03)


def test_load_step() -> None:
    """From the speeds: ω' changes by −(T − 10 N·m)/J at 0.6 s, and not before."""
    count = 64
    states = {}
    for condition in ("nominal", "load_step"):
        source = EpisodeSource("InductionMotor", condition=condition, duration=0.62)
        envs = make_vec(MOTOR, count, condition=condition, duration=0.62)
        states[condition] = [envs.reset(seed=0)[1]["state"]]
        for _ in range(source.setup.num_steps):
            states[condition].append(envs.step(states[condition][-1])[4]["state"])
    difference = np.array(states["load_step"]) - np.array(states["nominal"])
    assert abs(difference[:601] / SYSTEMS.resolve("InductionMotor").scale).max() < 1e-8
    torque = 10.0 - difference[601, :, 4] / 1e-3 * 0.0586
    assert torque.min() > -0.1
    assert torque.max() < 40.1
    assert torque.mean() == pytest.approx(20, abs=5)  # 3.5 standard errors
    assert torque.std() == pytest.approx(40 / np.sqrt(12), rel=0.25)


# Observations and infos


def test_motor_observation() -> None:
    """y, then u = (350 cos 300t, 300 sin 300t), then t/T."""
    episode = play(make(MOTOR, noise_std=0, **short("InductionMotor", 100)), seed=0)
    t = np.arange(101) * 1e-3
    observations = episode["observations"]
    assert observations.shape == (101, 5)
    assert observations[:, :2] == pytest.approx(episode["states"][:, :2], rel=1e-6, abs=1e-5)
    assert observations[:, 2] == pytest.approx(350 * np.cos(300 * t), rel=1e-5, abs=1e-3)
    assert observations[:, 3] == pytest.approx(300 * np.sin(300 * t), rel=1e-5, abs=1e-3)
    assert observations[:, 4] == pytest.approx(t / 0.1, abs=1e-6)


def spoil(value: Any) -> None:
    for array in value.values() if isinstance(value, dict) else [value]:
        array[...] = 77


@pytest.mark.parametrize("build", [make, lambda name, **kw: make_vec(name, 2, **kw)])
def test_what_is_returned_may_be_overwritten(build: Callable[..., Any]) -> None:
    arguments = short("ReverseDuffing", 6)
    env, twin = build(DUFFING, **arguments), build(DUFFING, **arguments)
    for episode in range(3):
        seed = 0 if episode in (0, 2) else None
        observation, info = env.reset(seed=seed)
        expected = twin.reset(seed=seed)
        for _ in range(6):
            assert np.array_equal(observation, expected[0])
            for name, value in expected[-1].items():
                assert np.array_equal(info[name], value)
            action = np.array(info["state"])
            spoil(observation)
            spoil(info)
            observation, *found, info = env.step(action.copy())
            expected = twin.step(action)
            for ours, theirs in zip(found, expected[1:4], strict=True):
                assert np.array_equal(ours, theirs)
                if isinstance(ours, np.ndarray):
                    ours[...] = 1


def test_record_is_what_was_observed() -> None:
    envs = make_vec(DUFFING, 2, **short("ReverseDuffing")).unwrapped
    assert isinstance(envs, EstimationVectorEnv)
    observations, infos = envs.reset(seed=0, options={"xhat0": [0.5, -0.5]})
    seen = [observations]
    for _ in range(11):
        observations, _, _, _, infos = envs.step(infos["state"])
        seen.append(observations)
    record = envs.record()
    assert record.t == pytest.approx(np.arange(12) * 0.02)
    y = np.moveaxis(record.y, 1, 0)
    assert y[..., 0] == pytest.approx(np.array(seen)[..., 0], abs=1e-6)
    assert record.u.shape == (2, 12, 0)
    assert record.prior.mean.tolist() == [[0.5, -0.5]] * 2


# Rendering


def test_rendering() -> None:
    env = make(DUFFING, render_mode="rgb_array", **short("ReverseDuffing"))
    _, info = env.reset(seed=0)
    first = env.render()
    assert isinstance(first, np.ndarray)
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape[2] == 3
    assert min(first.shape[:2]) > 100
    for _ in range(6):
        info = env.step(info["state"])[4]
    later = env.render()
    assert later.shape == first.shape
    assert (later != first).any()
    assert len(np.unique(later.reshape(-1, 3), axis=0)) > 10  # not blank
    env.close()


def test_vector_rendering() -> None:
    envs = make_vec(DUFFING, 2, render_mode="rgb_array", **short("ReverseDuffing"))
    _, infos = envs.reset(seed=0)
    for _ in range(5):
        infos = envs.step(infos["state"])[4]
    before = envs.render()
    for _ in range(5):
        infos = envs.step(infos["state"])[4]
    after = envs.render()
    assert before is not None
    assert after is not None
    assert [image.dtype for image in after] == [np.uint8, np.uint8]
    assert all((a != b).any() for a, b in zip(before, after, strict=True))
    assert (after[0] != after[1]).any()
    envs.close()


def test_rendering_without_a_mode_warns() -> None:
    env = make(DUFFING).unwrapped
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None


def test_a_masked_reset_leaves_the_other_rows_alone() -> None:
    """Neither their streams nor their prior change when others are seeded anew."""

    def play(masked: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        envs = EstimationVectorEnv(3, "Academic", duration=0.2)
        envs.reset(seed=0, options={"xhat0": [0.5, 0.5]})
        if masked:
            mask = np.array([True, False, False])
            envs.reset(seed=[70, 80, 90], options={"reset_mask": mask, "xhat0": [3.0, 3.0]})
        prior = envs.record().prior.mean
        observations, _ = envs.reset()
        return prior, observations, envs.record().prior.mean

    prior, following, default = play(masked=True)
    untouched_prior, untouched, _ = play(masked=False)
    np.testing.assert_array_equal(prior[0], [3.0, 3.0])
    np.testing.assert_array_equal(prior[1:], untouched_prior[1:])
    np.testing.assert_array_equal(following[1:], untouched[1:])
    assert not np.array_equal(following[0], untouched[0])
    np.testing.assert_array_equal(default, np.zeros((3, 2)))


def test_the_prior_is_told_again_after_an_autoreset() -> None:
    envs = EstimationVectorEnv(2, "Academic", duration=0.1)
    _, infos = envs.reset(seed=0, options={"xhat0": [0.5, 0.5]})
    actions = np.zeros((2, 2))
    for _ in range(5):
        *_, infos = envs.step(actions)
        assert "xhat0" not in infos
    *_, infos = envs.step(actions)
    np.testing.assert_array_equal(infos["_xhat0"], [True, True])
    np.testing.assert_array_equal(infos["xhat0"], np.zeros((2, 2)))
    np.testing.assert_array_equal(envs.record().prior.mean, infos["xhat0"])


def test_conditions_take_the_benchmarks_noise_where_the_setup_has_none() -> None:
    for condition in ("outliers", "noise5"):
        quiet = EstimationEnv("Academic", "paper", duration=2.0)
        loud = EstimationEnv("Academic", "paper", condition, duration=2.0)
        quiet.reset(seed=0)
        loud.reset(seed=0)
        off = []
        for _ in range(900):
            first, *_ = quiet.step(np.zeros(2))
            second, *_ = loud.step(np.zeros(2))
            off.append(second[0] - first[0])
        assert np.max(np.abs(off)) > 0.1, condition


@pytest.mark.parametrize("make", [gymnasium.make, partial(gymnasium.make_vec, num_envs=2)])
def test_unknown_arguments_list_the_known_ones(make) -> None:
    env = "reward, stack_outputs, render_mode"
    known = f"setup, condition, action_mode, {env}, dt, duration, noise_std, parameters"
    with pytest.raises(ValueError, match=f"^unknown argument 'foo'; known are {known}$"):
        make("pinnobs/Academic-v0", foo=1)
    with pytest.raises(ValueError, match=r"'noise'.*; did you mean 'noise_std'\?"):
        make("pinnobs/Academic-v0", noise=0.1)
    known = "setup, condition, dt, duration, noise_std, parameters"
    with pytest.raises(ValueError, match=f"^unknown argument 'noise'; known are {known}$"):
        simulate("Academic", 0, noise=0.1)


def test_an_episode_ended_early_is_drawn_no_further_than_it_went() -> None:
    """The truth to come is not in the picture, and the env wants a reset."""
    env = EstimationEnv("Academic", duration=2.0, render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.zeros(2))
    before = env.render()
    _, _, terminated, _, _ = env.step(np.array([np.nan, 0.0]))
    assert terminated
    after = env.render()
    assert before is not None
    assert after is not None
    halves = [image[:, image.shape[1] // 2 :] for image in (before, after)]
    np.testing.assert_array_equal(*halves)  # the later part of the time axis stays empty
    with pytest.raises(RuntimeError, match="the episode is over"):
        env.step(np.zeros(2))


def test_episodes_that_wait_for_their_row_are_its_next(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows that begin anew one by one, at given states, and all together, play what single envs
    do; and simulations are few."""
    blocks = []
    play = EpisodeSource.play
    monkeypatch.setattr(
        EpisodeSource,
        "play",
        lambda self, draws, *rest: blocks.append(1) or play(self, draws, *rest),
    )
    env = make_vec(DUFFING, 3, duration=0.5, condition="outliers")
    env.reset(seed=5)
    played: list[tuple[int, int, Any]] = []  # (row, episode of that row, observation)
    for row, episode in [(1, 1), (0, 1), (2, 1), (1, 2)]:
        mask = np.arange(3) == row
        observations, _ = env.reset(options={"reset_mask": mask})
        played.append((row, episode, observations[row]))
    assert len(blocks) == 3  # the first episodes, one more of each row, and further ones of row 1
    given = np.array([1.0, -0.5])
    observations, infos = env.reset(options={"reset_mask": np.arange(3) == 0, "x0": given})
    assert np.array_equal(infos["state"][0], given)
    played.append((0, 2, observations[0]))
    observations, _ = env.reset()
    played += [(0, 3, observations[0]), (1, 3, observations[1]), (2, 2, observations[2])]
    monkeypatch.undo()
    for row, episode, observation in played:
        single = make(DUFFING, duration=0.5, condition="outliers")
        single.reset(seed=5 + row)
        for _ in range(episode - 1):
            single.reset()
        if (row, episode) == (0, 2):
            expected = single.reset(options={"x0": given})[0]
        else:
            expected = single.reset()[0]
        np.testing.assert_allclose(observation, expected, atol=1e-7)


def test_a_state_is_measured_alone_if_the_output_is_that_state_at_any_time_and_input() -> None:
    assert measured_states(SYSTEMS.resolve("InductionMotor")()) == {0: 0, 1: 1}
    assert measured_states(Linear()) == {0: 0}  # y2 is twice the state
    assert measured_states(FeedThrough()) == {}
    assert measured_states(Modulated()) == {}


def test_the_scale_of_an_output_is_the_largest_over_an_episode() -> None:
    assert np.array_equal(output_scale(FeedThrough()), [1.0, 2.0])
    t = np.linspace(0.0, 2.0, 9)
    gain = 1 + 0.4 * (np.sin(t) + 0.5 * (np.cos(5 * t) + 0.3))
    assert output_scale(Modulated()) == pytest.approx([gain.max(), 2.0])
