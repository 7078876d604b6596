"""How scores were made: commands, settings, dates and versions."""

import shlex
import subprocess
import sys
import tomllib

import pytest
from page_rows import row

from pinnobs_gym import evaluate
from pinnobs_gym.cli import main
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site import method
from pinnobs_gym.scoring import rows


def test_commands_name_what_was_played():
    nominal = [row(seed, estimator=name) for seed in (2, 3) for name in ("ukf", "ekf")]
    other = [row(2, condition="noise5", ranked=False)]
    trained = {"config": {"budget": 4.0}, "per_record": True}
    setup = [row(0, setup="paper", estimator="pinn_obs (paper's loss)", training=trained)]
    nominal += [row(2, estimator="ukf, tuned")]
    assert method.commands(runs_of(nominal + other + setup)) == [
        "pinnobs leaderboard --systems A --estimators ekf ukf 'ukf, tuned' --episodes 2 --seed 2",
        "pinnobs leaderboard --systems A --estimators pinn_obs --setup paper --episodes 1 "
        "--trained-episodes 1 --budget 4",
        "pinnobs leaderboard --systems A --estimators ekf --condition noise5 --episodes 1 --seed 2",
    ]


def test_methods_name_settings_and_dates():
    options = {"gate": None, "assumed_noise": 3e-3, "config": {"layers": 3}}
    group = [row(0, options=options), row(1, options=options, date="2030-01-05T00:00:00")]
    (contender,) = contenders(runs_of(group))
    found = method.estimator_method(contender)
    assert found.settings == "assumed_noise=0.003, config: layers=3"
    assert (found.episodes, found.dates) == (2, "2030-01-02 to 2030-01-05")
    versions = method.versions([*group, row(versions={"numpy": "1", "torch": "3"})])
    assert versions == {"numpy": "1, 2", "torch": "3"}


PLUG_INS = """
from dataclasses import dataclass
from pinnobs_gym.estimators.open_loop import OpenLoop
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

@dataclass(frozen=True)
class Slow(OpenLoop):
    name = "slow"
    pace: float = 1.0

class Twin(ReverseDuffing):
    pass
"""
SUITE = """
estimators = [
    "own_plug_ins:Slow",
    { name = "ekf", label = "gated ekf", settings = { gate = 0.999 } },
    { name = "own_plug_ins:Slow", label = "slower", settings = { pace = 0.5 } },
    { name = "robust_ekf", settings = { huber = 3.0 } },
]
systems = ["own_plug_ins:Twin"]
episodes = 2
"""


@pytest.fixture
def plug_ins(tmp_path, monkeypatch):
    """A folder with a system and an estimator of a user's own, in which commands run."""
    (tmp_path / "own_plug_ins.py").write_text(PLUG_INS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    sys.modules.pop("own_plug_ins", None)


def played_by(arguments, folder):
    assert main([*arguments, "--jobs", "1", "--out", str(folder)]) == 0
    return rows.read(folder / "rows.jsonl")


def scores(found):
    return {(row["env_id"], row["estimator"], row["episode"]): row["nrmse"] for row in found}


def test_the_command_of_plug_ins_and_of_a_suite_plays_the_same(plug_ins):
    (plug_ins / "mine.toml").write_text(SUITE)
    first = played_by(["leaderboard", "--suite", "mine.toml"], plug_ins / "first")
    names = {"slow", "gated ekf", "slower", "robust_ekf"}
    assert {row["estimator"] for row in first} == names
    (command,) = method.commands(runs_of(first))
    *writing, line = command.splitlines()
    subprocess.run(["sh", "-c", "\n".join(writing)], check=True, timeout=60)
    suite = tomllib.loads((plug_ins / method.SUITE_FILE).read_text())
    assert len(suite["estimators"]) == 4
    again = played_by(shlex.split(line)[1:], plug_ins / "again")
    assert scores(again) == scores(first)
    assert len(scores(first)) == 8


def test_the_command_of_a_plug_in_alone_names_its_path(plug_ins):
    path = plug_ins / "rows.jsonl"
    evaluate("own_plug_ins:Slow", "ReverseDuffing", episodes=1, results=path)
    (command,) = method.commands(runs_of(rows.read(path)))
    expected = "pinnobs leaderboard --systems ReverseDuffing --estimators own_plug_ins:Slow"
    assert command == f"{expected} --episodes 1"


def test_what_no_command_plays_is_said():
    """A noise level that was told is no setting of a suite, nor is a class of a notebook."""
    told = row(0, settings={"noise_std": 0.2, "gate": 0.9}, options={"gate": 0.9})
    own = row(0, estimator="mine", made_by={"estimator": "__main__:Mine"})
    (command,) = method.commands(runs_of([told, own]))
    assert command.splitlines()[-2:] == [
        "# ekf: without its noise_std, which evaluate() has",
        "# mine: of a script or a notebook; put it in a module first",
    ]
    assert '{ name = "ekf", settings = { gate = 0.9 } }' in command


def test_a_recipe_becomes_a_preset_and_training_seeds_are_named():
    config = {"budget": 4.0, "preset": "plain"}
    usual = [
        row(0, estimator="pinn_gain", training={"config": config}, training_seed=i) for i in (0, 1)
    ]
    (command,) = method.commands(runs_of(usual))
    assert command.endswith("--episodes 1 --budget 4 --training-seeds 0 1")
    from dataclasses import asdict

    from pinnobs_gym.estimators import ESTIMATORS

    plain = ESTIMATORS.resolve("pinn_obs").trainer_config({"preset": "plain"})
    training = {"config": asdict(plain), "per_record": True}
    (command,) = method.commands(
        runs_of([row(0, estimator="pinn_obs (paper's loss)", training=training)])
    )
    assert '{ name = "pinn_obs", settings = { preset = "plain" } }' in command
