"""Policies as estimators: their scores are those of the env stepped with their actions."""

from __future__ import annotations

import pickle
import zipfile

import numpy as np
import pytest
from made_envs import make, short
from stable_baselines3 import A2C, PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.policy import load_policy, policy_of
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.provenance import estimator_hash

NAME = "ReverseDuffing"
ID = "pinnobs/ReverseDuffing-v0"
SHORT = short(NAME, 12)


def model_of(env, kind=PPO):
    return kind("MlpPolicy", env, seed=0, device="cpu", policy_kwargs={"net_arch": [8]})


def untrained(kind=PPO, **arguments):
    return model_of(make(ID, **SHORT, **arguments), kind)


def stepped(act, seed, **arguments):
    """The errors (num_steps, nx) of an episode of the env, stepped by hand."""
    env = make(ID, **SHORT, **arguments)
    observation, info = env.reset(seed=seed)
    errors, over = [], False
    while not over:
        action = act(observation)
        x = info["state"]
        observation, reward, _, over, info = env.step(action)
        errors.append((reward, x))
    return errors


@pytest.mark.parametrize("condition", ["nominal", "dropout30", "noise5"])
@pytest.mark.parametrize("mode", ["estimate", "normalized", "gain", "correction"])
def test_its_scores_are_those_of_the_env(mode, condition):
    model = untrained(action_mode=mode, condition=condition)
    game = Game.of(NAME, condition=condition, **SHORT)
    lossy = game.source.condition.loses_outputs
    policy = policy_of(model, game.source.system, game.source.setup, loses_outputs=lossy)
    assert policy.action_mode == mode
    played = play(game, policy, [3, 4])
    for row, seed in enumerate((3, 4)):
        by_hand = stepped(
            lambda seen: model.predict(seen, deterministic=True)[0],
            seed,
            action_mode=mode,
            condition=condition,
        )
        scale = np.array(played.system.scale)
        for k, (reward, x) in enumerate(by_hand):
            error = (played.estimates.xhat[row, k] - x) / scale
            assert -np.mean(error**2) == pytest.approx(reward, rel=1e-4, abs=1e-7)


def test_a_model_without_a_mask_plays_where_outputs_are_lost():
    """It sees the last outputs, as it would without a mask."""
    model = untrained(action_mode="normalized")
    game = Game.of(NAME, condition="dropout30", **SHORT)
    policy = policy_of(model, game.source.system, game.source.setup, loses_outputs=True)
    assert not policy.mask
    assert np.isfinite(play(game, policy, [0]).estimates.xhat).all()


def test_a_function_is_a_policy():
    """It sees the env's observations, a row of each episode."""
    held = []

    def last(observations):
        held.append(observations)
        return np.stack([observations[:, 0], 0 * observations[:, 0]], axis=1)

    rows = evaluate(last, NAME, episodes=2, setup="benchmark")
    assert rows[0]["estimator"] == "last"
    seen = np.stack([each for each in held if len(each) == 2], axis=1)
    record = Game.of(NAME).record([0, 1])
    np.testing.assert_allclose(seen[..., 0], record.y[..., 0], rtol=1e-6)
    np.testing.assert_allclose(seen[0, :, 1], record.t / Game.of(NAME).source.times[-1], rtol=1e-6)
    assert rows[0]["nrmse"] != rows[1]["nrmse"]


def test_its_observations_are_normalised_as_in_training(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: make(ID, action_mode="gain", **SHORT)]))
    env.reset()
    for _ in range(30):
        env.step(np.zeros((1, 2)))
    model = model_of(env)
    game = Game.of(NAME, **SHORT)
    policy = policy_of(model, game.source.system, game.source.setup)
    observation = np.ones((1, 4), np.float32)
    assert policy.normalize is not None
    expected = np.clip((1 - env.obs_rms.mean) / np.sqrt(env.obs_rms.var + 1e-8), -10, 10)
    np.testing.assert_allclose(policy.normalize(observation)[0], expected, rtol=1e-5)
    model.save(tmp_path / "model.zip")
    env.save(str(tmp_path / "statistics.pkl"))
    loaded, normalize = load_policy(tmp_path / "model.zip", tmp_path / "statistics.pkl")
    again = policy_of(
        loaded, game.source.system, game.source.setup, action_mode="gain", normalize=normalize
    )
    xhat = [play(game, each, [0]).estimates.xhat for each in (policy, again)]
    np.testing.assert_array_equal(*xhat)
    assert estimator_hash(policy) == estimator_hash(again)


@pytest.mark.parametrize("kind", [PPO, A2C, SAC])
def test_a_saved_model_acts_as_the_model(kind, tmp_path):
    model = untrained(kind, action_mode="gain")
    model.save(tmp_path / "model.zip")
    loaded, _ = load_policy(tmp_path / "model.zip")
    seen = np.random.default_rng(0).standard_normal((5, 4)).astype(np.float32)
    actions = [each.predict(seen, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)


def test_scores_of_other_weights_are_never_taken():
    game = Game.of(NAME, **SHORT)
    made = [policy_of(untrained(), game.source.system, game.source.setup) for _ in range(2)]
    assert estimator_hash(made[0]) == estimator_hash(made[1])
    weights = next(made[1].policy.policy.parameters())
    weights.data[0] += 1
    other = policy_of(made[1].policy, game.source.system, game.source.setup)
    assert estimator_hash(other) != estimator_hash(made[0])
    function = policy_of(lambda seen: seen, game.source.system, game.source.setup)
    assert function.label == "policy"
    again = policy_of(function.policy, game.source.system, game.source.setup)
    assert estimator_hash(again) != estimator_hash(function)


def test_what_does_not_fit_is_refused():
    model = untrained(action_mode="gain")
    with pytest.raises(ValueError, match=r"PPO has observations \(4,\) .*'gain' has \(10,\)"):
        evaluate(model, "InductionMotor", episodes=1)
    with pytest.raises(ValueError, match="option 'gain' of a policy; expected one of action_mode"):
        evaluate(model, NAME, episodes=1, options={"gain": 1})
    with pytest.raises(ValueError, match=r"returned actions of shape \(1, 1\) for 1"):
        evaluate(lambda seen: seen[:, :1], NAME, episodes=1)
    env = VecFrameStack(DummyVecEnv([lambda: make(ID, **SHORT)]), 3)
    with pytest.raises(ValueError, match="with the wrapper VecFrameStack, which changes"):
        evaluate(model_of(env), NAME, episodes=1)


def test_a_model_without_its_env_needs_its_action_mode(tmp_path):
    untrained(action_mode="gain").save(tmp_path / "model.zip")
    model = PPO.load(tmp_path / "model.zip", device="cpu")
    told = r"expected action_mode 'gain' or 'correction'.* --set action_mode=gain\)$"
    with pytest.raises(ValueError, match=told):
        evaluate(model, NAME, episodes=1)
    assert len(evaluate(model, NAME, episodes=1, options={"action_mode": "gain"})) == 1


class Bomb:
    """What writes a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return open, (self.path, "w")


def test_the_command_says_that_files_hold_code_before_it_loads_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    untrained(action_mode="normalized").save(tmp_path / "agent.zip")
    command = ["evaluate", "--system", ID, "--episodes", "1", "--out", "out"]
    assert (
        main([*command, "--estimator", "policy:agent.zip", "--set", "action_mode=normalized"]) == 0
    )
    said = capsys.readouterr().out
    assert said.index("agent.zip can hold code") < said.index("episodes")
    (tmp_path / "bomb.pkl").write_bytes(pickle.dumps(Bomb(tmp_path / "it ran")))
    monkeypatch.setattr("pinnobs_gym.cli.commands.evaluate.load_policy", _stopped)
    bomb = ["--estimator", "policy:agent.zip", "--normalization", "bomb.pkl"]
    assert main([*command, *bomb]) == 2
    told = capsys.readouterr()
    assert "bomb.pkl can hold code" in told.out
    assert "stopped here" in told.err
    assert not (tmp_path / "it ran").exists()


def _stopped(*files):
    raise ValueError("stopped here")


@pytest.mark.parametrize(
    "command",
    [
        ["leaderboard", "--systems", NAME, "--estimators", "policy:agent.zip"],
        ["leaderboard", "--suite", "suite.toml"],
        ["estimate", "--system", NAME, "--log", "log.csv", "--estimator", "policy:agent.zip"],
    ],
)
def test_no_other_command_loads_such_a_file(command, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log.csv").write_text("t,y1\n0,1\n1,1\n")
    (tmp_path / "suite.toml").write_text(
        f'systems = ["{NAME}"]\nestimators = ["policy:agent.zip"]\nepisodes = 1\n'
    )
    with zipfile.ZipFile(tmp_path / "agent.zip", "w") as archive:
        archive.writestr("data", pickle.dumps(Bomb(tmp_path / "it ran")))
    assert main(command) == 2
    assert "pinnobs evaluate alone" in capsys.readouterr().err
    assert not (tmp_path / "it ran").exists()


@pytest.mark.parametrize("content", [b"", b"no archive", None])
def test_a_file_that_is_no_model_is_told(content, tmp_path):
    path = tmp_path / "agent.zip"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ValueError, match=r"agent.zip (holds no model of SB3|is not there)"):
        load_policy(path)
