"""Agents of Stable-Baselines3: what they learn, what estimators make of them, and their files."""

from __future__ import annotations

import ast
import itertools
import json
import pickle
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch
import yaml
from made_envs import make
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main as cli
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimation.checks import check_estimator
from pinnobs_gym.estimators.sb3 import Sb3, TrainedAgent
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.training.by_name import train_by_name, trainer_of
from pinnobs_gym.training.log import Log
from trainers.rl import RLConfig, RLTrainer
from trainers.rl.agent import options
from trainers.rl.config import Algorithm, Mode

DUFFING = Game.of("ReverseDuffing")
SMALL = {"steps": 512, "rows": 4, "rollout": 16, "batch": 32, "epochs": 2, "width": 8}
SMALL |= {"held_out": 4, "check_every": 256}
KINDS = list(zip(get_args(Algorithm), itertools.cycle(get_args(Mode))))
"""Every algorithm, and among them every mode."""


def small(algorithm: str = "ppo", mode: str = "gain", **changes: Any) -> RLConfig:
    buffer = {"buffer": 1000} if RLTrainer.configured({"preset": algorithm}).buffer else {}
    preset = f"{algorithm}_normalized" if mode == "normalized" else algorithm
    given = {**SMALL, **buffer, "action_mode": mode, **changes}
    return RLTrainer.configured({"preset": preset, **given})


def begun(system: str, config: RLConfig) -> Any:
    """A training that has not made a step."""
    return trainer_of("rl", config, Game.of(system))


def train_rl(config: RLConfig, game: Game, **options: Any) -> Any:
    """The agent that comes of a training."""
    return train_by_name("rl", config, game, **options)


class Bomb:
    """What writes a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return open, (str(self.path), "w")


@pytest.fixture(scope="module")
def agent() -> TrainedAgent:
    return train_rl(small(), DUFFING)


def scores(estimator: Sb3) -> list[float]:
    return [
        row["nrmse"] for row in evaluate(estimator, DUFFING.name.env_id, episodes=3, seed=2_000_000)
    ]


# What it computes


@pytest.mark.parametrize(("algorithm", "mode"), KINDS)
def test_actions_are_those_of_sb3(algorithm: str, mode: str) -> None:
    """Without exploration, with normalisation, over steps that a recurrent layer remembers."""
    training = begun("ReverseDuffing", small(algorithm, mode))
    env, model = training.env, training.agent
    rng = np.random.default_rng(0)
    features = env.reset()
    for _ in range(30):
        features = env.step(rng.uniform(-1, 1, (4, 2)).astype(np.float32))[0]
    generator = torch.Generator().manual_seed(1)
    for parameter in model.policy.parameters():  # weights as if trained
        parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    kept = training.result()
    state, theirs = kept.begin(4), None
    env.training = False
    for _ in range(5):
        raw = rng.standard_normal((4, features.shape[1]))
        own, state = kept.act(raw, state)
        peer, theirs = model.predict(
            env.normalize_obs(raw),
            theirs,
            episode_start=np.array([theirs is None] * 4),
            deterministic=True,
        )
        np.testing.assert_allclose(own, peer, atol=1e-5)


@pytest.mark.parametrize(
    ("system", "mode"),
    [("InductionMotor", "gain"), ("Satellite", "correction"), ("HarmonicOscillator", "normalized")],
)
def test_conforms(system: str, mode: str) -> None:
    plant = SYSTEMS.resolve(system)()
    check_estimator(Sb3(plant, trained=begun(system, small(mode=mode)).result()))


def test_the_estimator_is_the_agent_in_its_env() -> None:
    """The estimates of a record are those that the env scores when the agent plays it."""
    kept = begun("ReverseDuffing", small(rows=3, batch=48)).result()
    env = DUFFING.vector_env(3, action_mode=kept.action_mode)
    observations, infos = env.reset(seed=9)
    estimator = Sb3(ReverseDuffing(), kept.setup["noise_std"], trained=kept)
    expected = estimator.run(env.record()).xhat
    hidden = kept.begin(3)
    for k in range(200):
        actions, hidden = kept.act(observations, hidden)
        error = (expected[:, k] - infos["state"]) / np.array(ReverseDuffing.scale)
        observations, rewards, *_, infos = env.step(actions)
        np.testing.assert_allclose(rewards, -(error**2).mean(axis=1), rtol=1e-3, atol=1e-6)


# What it learns


@pytest.mark.slow
def test_the_best_gain_of_a_schedule_is_learned() -> None:
    """In 8,192 steps the agent comes from the model alone (NRMSE about one) to a small tail."""
    config = RLConfig(steps=8192, rows=32, batch=256, check_every=4096, held_out=8)
    learned = train_rl(config, DUFFING)
    rows = evaluate(
        Sb3(ReverseDuffing(), learned.setup["noise_std"], trained=learned),
        DUFFING.name.env_id,
        episodes=20,
        seed=2_000_000,
    )
    assert np.median([row["nrmse_tail"] for row in rows]) < 0.05


def test_same_seed_same_agent(agent: TrainedAgent) -> None:
    again, other = train_rl(small(), DUFFING), train_rl(small(seed=1), DUFFING)
    assert agent.loss == again.loss != other.loss
    assert np.array_equal(agent.layers[0][0], again.layers[0][0])


def test_logs_in_sb3s_layout(tmp_path: Path) -> None:
    with Log(tmp_path) as log:
        train_rl(small(), DUFFING, log=log)
    found = EventAccumulator(str(tmp_path))
    found.Reload()
    tags = set(found.Tags()["scalars"])
    expected = {"train/loss", "time/fps", "held_out/nrmse_tail_modulo", "held_out/diverged"}
    assert expected <= tags


@pytest.mark.usefixtures("ticking")
def test_ends_on_its_budget() -> None:
    ended = train_rl(small(steps=10**9, budget=0.3), DUFFING)
    assert ended.ending == "budget"
    assert ended.steps <= 64 * 30  # the time is looked at after each rollout
    assert 0.3 <= ended.seconds < 0.6
    assert np.isfinite(ended.loss)


def test_resumes(tmp_path: Path) -> None:
    checkpoint = tmp_path / "agent.pt"
    first = train_rl(small(), DUFFING, checkpoint=checkpoint)
    pickled = pickle.dumps(Bomb(tmp_path / "it ran"))
    for name in ("agent.pkl", "agent.vecnormalize.pkl", "agent.zip"):
        (tmp_path / name).write_bytes(pickled)
    more = train_rl(small(steps=1024), DUFFING, checkpoint=checkpoint, resume=True)
    assert (first.steps, more.steps) == (512, 1024)
    assert more.loss <= first.loss
    assert more.seconds > first.seconds
    torch.save({"checkpoint": Bomb(tmp_path / "it ran")}, checkpoint)
    with pytest.raises(ValueError, match=r"agent.pt is damaged .*it holds a '\w+ open'; expected"):
        train_rl(small(), DUFFING, checkpoint=checkpoint, resume=True)
    checkpoint.write_bytes(pickled)
    with pytest.raises(ValueError, match="is damaged or no file of saved weights"):
        train_rl(small(), DUFFING, checkpoint=checkpoint, resume=True)
    assert not (tmp_path / "it ran").exists()


# Files


@pytest.mark.parametrize(("algorithm", "mode"), KINDS)
def test_a_loaded_agent_has_the_same_scores_to_the_bit(
    tmp_path: Path, algorithm: str, mode: str
) -> None:
    trained = train_rl(small(algorithm, mode, steps=128), DUFFING)
    trained.save(tmp_path / "agent.pt")
    loaded = Sb3.load(tmp_path / "agent.pt", ReverseDuffing())
    made = Sb3(ReverseDuffing(), trained.setup["noise_std"], trained=trained)
    assert scores(loaded) == scores(made)
    assert loaded.training == made.training


def test_its_rows_say_what_training_saw(agent: TrainedAgent) -> None:
    estimator = Sb3(ReverseDuffing(), agent.setup["noise_std"], trained=agent)
    row = evaluate(estimator, DUFFING.name.env_id, episodes=1, seed=2_000_000)[0]
    assert row["track"] == "online"
    assert "true states in training" in row["knows"]
    assert row["training"]["reward"] == "of the true states"
    assert row["training"]["trainer"] == "rl"


def test_through_the_command(tmp_path: Path, capsys: Any) -> None:
    steps = ["--steps", "256", "--rows", "4", "--rollout", "16", "--batch", "32"]
    steps += ["--held-out", "4", "--width", "8"]
    common = ["--system", "ReverseDuffing", "--out", str(tmp_path)]
    assert cli(["train", "rl", *common, *steps]) == 0
    path = next(p for p in tmp_path.glob("*.pt") if "checkpoint" not in p.name)
    assert "sb3 on own record" in capsys.readouterr().out
    kinds = {path.suffix for path in tmp_path.iterdir() if path.is_file()}
    assert kinds == {".pt", ".png"}
    chosen = ["--estimator", "sb3", "--trained", str(path), "--episodes", "2"]
    assert cli(["evaluate", *common, *chosen]) == 0
    assert "true states in training" in capsys.readouterr().out


# Bad input


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"system": "Academic"}, "trained with system='Academic'; expected 'ReverseDuffing'"),
        ({"sb3": "1.8.0"}, "trained with stable-baselines3 1.8.0; .* another major version"),
        ({"action_mode": "normalized"}, r"sizes=\[4, 2\]; expected \[2, 2\]"),
        ({"action_mode": "x"}, "unknown action_mode 'x'"),
        ({"normalization": None}, "is not a saved TrainedAgent"),
    ],
)
def test_bad_files(tmp_path: Path, agent: TrainedAgent, changes: dict[str, Any], says: str) -> None:
    path = tmp_path / "agent.pt"
    replace(agent, **changes).save(path)
    with pytest.raises(ValueError, match=says) as error:
        TrainedAgent.load(path, ReverseDuffing())
    assert "\n" not in str(error.value)


def test_of_the_same_sizes_the_file_alone_says_what_actions_mean(
    tmp_path: Path, agent: TrainedAgent
) -> None:
    replace(agent, action_mode="correction").save(tmp_path / "agent.pt")
    found = TrainedAgent.load(tmp_path / "agent.pt", ReverseDuffing())
    assert (agent.action_mode, found.action_mode) == ("gain", "correction")


def test_other_files(tmp_path: Path, agent: TrainedAgent) -> None:
    with pytest.raises(ValueError, match="cannot read"):
        TrainedAgent.load(tmp_path / "none.pt", ReverseDuffing())
    path = tmp_path / "agent.pt"
    path.write_bytes(b"zip")
    with pytest.raises(ValueError, match="is damaged or no file of saved weights"):
        TrainedAgent.load(path, ReverseDuffing())
    torch.save({"facts": json.dumps({}), "normalization": []}, path)
    with pytest.raises(ValueError, match="is not a saved TrainedAgent"):
        TrainedAgent.load(path, ReverseDuffing())


def test_bad_checkpoints(tmp_path: Path) -> None:
    checkpoint = tmp_path / "agent.pt"
    go_on = {"checkpoint": checkpoint, "resume": True}
    with pytest.raises(ValueError, match=r"cannot read .*agent"):
        train_rl(small(), DUFFING, **go_on)
    train_rl(small(steps=64), DUFFING, checkpoint=checkpoint)
    academic = Game.of("Academic")
    with pytest.raises(ValueError, match="trained with system='ReverseDuffing'; expected 'Acad"):
        train_rl(small(), academic, **go_on)
    with pytest.raises(ValueError, match="action_mode='gain'; expected 'correction'"):
        train_rl(small(mode="correction"), DUFFING, **go_on)
    with pytest.raises(ValueError, match="algorithm='ppo'; expected 'sac'"):
        train_rl(small("sac"), DUFFING, **go_on)
    checkpoint.write_bytes(b"zip")
    with pytest.raises(ValueError, match="is damaged or no file of saved weights"):
        train_rl(small(), DUFFING, **go_on)
    with pytest.raises(ValueError, match="without a checkpoint"):
        train_rl(small(), DUFFING, resume=True)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"algorithm": "dqn"}, "algorithm='dqn'; expected ppo, sac"),
        ({"action_mode": "estimate"}, "action_mode='estimate'; expected gain, correction or"),
        ({"steps": 0}, "steps=0; expected a whole number"),
        ({"stack": 3}, "stack=3; expected 1, since there is a prediction"),
        ({"gamma": 1.5}, "gamma=1.5; expected a number from 0 to 1"),
        ({"batch": 500}, "batch=500; expected a divisor of rows·rollout = 4096"),
        (
            {"algorithm": "sac"},
            "buffer=0; expected a positive whole number with sac; the preset sac",
        ),
    ],
)
def test_bad_settings(arguments: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        RLConfig(**arguments)


# Scripts and hyperparameter files

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.mark.parametrize("path", sorted((SCRIPTS / "zoo").iterdir()), ids=lambda path: path.name)
def test_the_zoos_files_name_all_envs_and_hold_our_defaults(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    read = yaml.safe_load(text)
    made = {name: ast.literal_eval(value) for name, value in re.findall(r"(\w+):\"(.*?)\"", text)}
    assert set(made) == {"action_mode", "reward"}
    assert set(read) == {env_id(cls) for cls in SYSTEMS.classes().values()}
    config = RLTrainer.configured({"preset": path.stem})
    chosen = options(config, 2)
    for name, held in read.items():
        assert make(name, **made).action_space.high.max() == 1
        assert (held["n_envs"], held["n_timesteps"]) == (config.rows, config.steps)
        schedule, rate = held["learning_rate"].split("_")
        assert (schedule, float(rate)) == ("lin", config.learning_rate)
        policy = eval(held["policy_kwargs"], {"nn": torch.nn, "dict": dict})  # as the Zoo does
        assert policy == {**chosen["policy_kwargs"], **policy}
        rest = set(held) & set(chosen) - {"learning_rate", "policy_kwargs"}
        assert {"batch_size", "gamma"} < rest
        assert all(held[key] == chosen[key] for key in rest)
        assert ("noise_std" in held) == ("action_noise" in chosen)
        if "action_noise" in chosen:
            np.random.seed(0)  # noqa: NPY002 - it draws from NumPy's own stream
            spread = np.std([chosen["action_noise"]() for _ in range(5000)])
            assert held["noise_std"] == pytest.approx(spread, rel=0.03)


def test_the_script_trains_scores_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--system", "ReverseDuffing", "--episodes", "3", "--out", str(tmp_path)]
    arguments += ["--steps", "4096"]

    def run(*more: str) -> str:
        monkeypatch.setattr(sys, "argv", ["train_rl.py", *arguments, *more])
        runpy.run_path(str(SCRIPTS / "train_rl.py"), run_name="__main__")
        return capsys.readouterr().out

    first = run()
    lines = [line.split()[:3] for line in first.splitlines()[1:]]
    assert [line[1] for line in lines] == ["open_loop", "ekf", "ppo,"]
    files = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.glob("*.pt")}
    assert run() == first
    assert files == {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in tmp_path.glob("*.pt")}
    with pytest.raises(SystemExit, match=r"train_rl: error: .*with steps=4096; expected 8192"):
        run("--steps=8192")
