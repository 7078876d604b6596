"""Options of commands, and settings of estimators."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest

from pinnobs_gym.cli import main
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.estimation.estimator import OfflineEstimator
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.luenberger import Luenberger
from pinnobs_gym.estimators.pinn_obs import PinnObs


@dataclass(frozen=True)
class Many(OfflineEstimator):
    flag: bool = False
    whole: int | None = 3
    word: Literal["a", "b"] = "a"
    several: tuple[float, ...] | None = ()
    two: tuple[float, int] = (1.0, 2)
    path: Path = Path("x")
    text: str | None = "x"
    number: float = 1.0
    anything: Any = None


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("flag=True", True),
        ("flag=False", False),
        ("whole=7", 7),
        ("whole=None", None),
        ("word=b", "b"),
        ("several=-1,-2e-3", (-1.0, -2e-3)),
        ("several=1 2", (1.0, 2.0)),
        ("several=", ()),
        ("several=None", None),
        ("two=0.5,3", (0.5, 3)),
        ("path=a/b c", Path("a/b c")),
        ("text=a b", "a b"),
        ("text=a=b", "a=b"),
        ("text=None", None),
        ("number=-1e-3", -1e-3),
    ],
)
def test_a_setting_is_parsed_by_the_type_of_its_field(setting, value):
    (parsed,) = settings_of(Many, [setting]).values()
    assert parsed == value
    assert type(parsed) is type(value)


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("flag=banana", "True or False"),
        ("flag=", "True or False"),
        ("whole=3.0", "None or a whole number"),
        ("word=c", "a or b"),
        ("word=", "a or b"),
        ("several=1,x", "None or a list of numbers"),
        ("two=1", "a list of a number, a whole number"),
        ("two=1,2.5", "a list of a number, a whole number"),
        ("number=a", "a number"),
        ("number=None", "a number"),
    ],
)
def test_wrong_values_of_settings(setting, expected):
    with pytest.raises(ValueError, match=r"^setting") as error:
        settings_of(Many, [setting])
    assert str(error.value) == f"setting {setting!r}; expected {expected}"


def test_what_cannot_be_written_on_a_command_line():
    with pytest.raises(ValueError, match="setting 'anything' can be given in Python only"):
        settings_of(Many, ["anything=1"])


def test_settings_of_known_estimators():
    assert settings_of(EKF, ["gate=None", "huber=1.3"]) == {"gate": None, "huber": 1.3}
    assert settings_of(Luenberger, ["poles=-1+1j,-1-1j"]) == {"poles": [-1 + 1j, -1 - 1j]}
    config = settings_of(PinnObs, ["transfer=False", "budget=None", "iterations=20"])["config"]
    assert (config.transfer, config.budget, config.iterations) == (False, None, 20)


def test_settings_start_from_the_recipe_of_the_estimator(monkeypatch):
    monkeypatch.setattr(PinnObs, "recipe", {"preset": "transfer"}, raising=False)
    assert settings_of(PinnObs, [])["config"].transfer
    assert settings_of(PinnObs, ["iterations=20"])["config"].transfer
    assert not settings_of(PinnObs, ["preset=guided"])["config"].transfer


def test_a_setting_given_twice():
    assert settings_of(EKF, ["huber=1", "huber=1.0"]) == {"huber": 1.0}
    with pytest.raises(ValueError, match=r"^setting 'huber' is given twice: '1' and '2'$"):
        settings_of(EKF, ["huber=1", "huber=2"])


@dataclass(frozen=True)
class Options:
    name: str = "x"
    set: tuple[str, ...] = ()
    seeds: tuple[int, ...] | None = None
    P0_std: tuple[float, ...] = ()
    fresh: bool = False
    known: ClassVar[tuple[str, ...]] = ()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("--set a=1 b=2", Options(set=("a=1", "b=2"))),
        ("--set a=1 --set b=2", Options(set=("a=1", "b=2"))),
        ("--set=a=1 --name y --set b=2 c=3", Options("y", set=("a=1", "b=2", "c=3"))),
        ("--seeds 1 --seeds 2 3", Options(seeds=(1, 2, 3))),
        ("--P0-std -1 --P0_std=-1e-3", Options(P0_std=(-1.0, -1e-3))),
        ("--fresh --name=y", Options("y", fresh=True)),
    ],
)
def test_values_of_repeated_options_add_up(line, expected):
    assert parse(Options, "test", line.split()) == expected


@pytest.mark.parametrize("line", ["--name a --name b", "--name=a --name b", "--name a --name a"])
def test_an_option_of_one_value_is_given_once(line):
    with pytest.raises(ValueError, match=r"^--name is given twice; expected once$"):
        parse(Options, "test", line.split())


def test_a_flag_and_its_opposite():
    for line in ("--fresh --no-fresh", "--no-fresh --fresh", "--fresh --fresh"):
        with pytest.raises(ValueError, match=r"^--fresh is given twice; expected once$"):
            parse(Options, "test", line.split())


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("evaluate --system Academic --set huber=1 --set huber=2", "'huber' is given twice"),
        ("evaluate --system Academic --set gate=x", "'gate=x'; expected None or a number"),
        ("estimate --system Academic --log a.csv --out b.csv --out c.csv", "--out is given twice"),
        (
            "evaluate --system Academic --estimator pinn_obs --set transfer=banana",
            "setting 'transfer=banana'; expected True or False",
        ),
        (
            "evaluate --system Academic --estimator pinn_obs --set preset=x --set iterations=20",
            "preset='x'; expected one of guided, plain, transfer, paper",
        ),
        ("leaderboard --condition nominal --condition fog", "unknown condition 'fog'"),
        ("leaderboard --condition fog --condition nominal", "unknown condition 'fog'"),
        ("leaderboard --systems Academic --systems Academic", "expected each but once"),
        ("leaderboard --estimators kf --estimators ekf", "unknown estimator 'kf'"),
        ("leaderboard --budget 1 --budget -1", "budgets=[1.0, -1.0]; expected a list of positive"),
        ("leaderboard --training-seeds -1 --training-seeds 0", "training_seeds=[-1, 0]; expected"),
        ("leaderboard --training-seeds 4294967296", "whole numbers from 0 to 4294967295"),
        ("report --rows a --rows b", "pinnobs report --help"),
        ("report none.jsonl --out a --out b", "--out is given twice; expected once"),
        ("tune ekf --system Academic --seed -3 --trials 1", "seed=-3; expected a whole number"),
        ("train pinn_obs --system Academic --preset", "'--preset'. Expected 1 value"),
        ("train pinn_obs --preset plain --system Academic --preset paper", "--preset is given tw"),
        ("train pinn_obs --system Academic --preset=x", "preset='x'; expected one of guided"),
        ("train pinn_obs --system Academic --episode -3", "episode=-3; expected a whole number"),
        ("train pinn_obs --system Academic --seed -3", "seed=-3; expected a whole number from 0"),
    ],
)
def test_mistakes_are_one_line_and_status_two(tmp_path, monkeypatch, capsys, line, message):
    monkeypatch.chdir(tmp_path)
    assert main(line.split()) == 2
    (printed,) = capsys.readouterr().err.splitlines()
    assert message in printed
    assert printed.startswith("pinnobs: error: ")


@dataclass(frozen=True)
class Numbers:
    whole: int = 1
    number: float = 1.0
    several: tuple[float, ...] = ()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--whole", "1_0"], "--whole: '1_0'; expected a whole number of at most 18 digits"),
        (["--whole", "\uff11"], "--whole: '\uff11'; expected a whole number"),
        (["--whole", "1" * 5000], "expected a whole number of at most 18 digits"),
        (["--number", "1_0"], "--number: '1_0'; expected a number"),
        (["--number", "1e400"], "--number: '1e400'; expected a number below 1e308"),
        (["--several"], "--several without a value; expected one or several"),
        (["--number", ""], "--number '' is empty; expected a value"),
        (["--number="], "--number '' is empty; expected a value"),
    ],
)
def test_numbers_are_in_plain_digits(arguments, says):
    with pytest.raises(ValueError, match=re.escape(says)) as caught:
        parse(Numbers, "x", arguments)
    assert len(str(caught.value)) < 200


def test_plain_numbers_are_read():
    arguments = ["--whole", "-3", "--number", "inf", "--several", "1e-3", "-2", ".5"]
    assert parse(Numbers, "x", arguments) == Numbers(-3, float("inf"), (1e-3, -2.0, 0.5))


@pytest.mark.parametrize("text", ["1_0", "\uff11", "1e400", "nan", "9" * 5000])
def test_numbers_of_settings_are_in_plain_digits(text):
    with pytest.raises(ValueError, match=r"setting .*; expected") as caught:
        settings_of(Many, [f"number={text}"])
    assert len(str(caught.value)) < 150


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--episodes", "-1"], "episodes=-1; expected at least 1"),
        (["--episodes", "10000001"], "episodes=10000001; expected at most 10000000"),
        (["--seed", "-1"], "seed=-1; expected at least 0"),
        (["--seed", "9223372036854775808"], "--seed: '9223372036854775808'; expected a whole"),
    ],
)
def test_numbers_of_episodes(tmp_path, monkeypatch, capsys, arguments, says):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "--system", "ReverseDuffing", *arguments]) == 2
    assert says in capsys.readouterr().err
