"""What a newcomer meets first: the version, help, names, near misses and the next command."""

import os
import subprocess
import sys
from dataclasses import fields
from importlib.metadata import version

import pytest

from pinnobs_gym.cli import COMMANDS, main
from pinnobs_gym.cli.commands.estimators import settings
from pinnobs_gym.envs.actions import LARGEST_CORRECTION
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.registry import TRAINERS, did_you_mean
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.systems.academic import Academic
from pinnobs_gym.training.progress import in_terminal, shown_progress

pty = pytest.importorskip("pty")
UNDESCRIBED = """
from dataclasses import dataclass

from pinnobs_gym import Estimator, State


@dataclass(frozen=True)
class Mine(Estimator):
    rate: float = 60.0

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        return state
"""


def test_the_version(capsys):
    assert main(["--version"]) == 0
    assert version("pinnobs-gym") in capsys.readouterr().out


def test_help_of_train_names_the_trainers_and_the_estimators_that_they_make(capsys):
    assert main(["train", "--help"]) == 0
    said = capsys.readouterr().out
    assert "pinn_obs_direct, pinn_obs_replay" in said
    assert "next: pinnobs train " in said


@pytest.mark.parametrize("name", TRAINERS.sources)
def test_every_trainer_has_help_with_its_settings(name, capsys):
    """No setting has the name of an option of the command itself."""
    assert main(["train", name, "--help"]) == 0
    said = capsys.readouterr().out
    for field in fields(TRAINERS.resolve(name).configured({})):
        assert f"--{field.name.replace('_', '-')}" in said


@pytest.mark.parametrize("spec", ["Academic", "pinnobs/Academic-v0", "Academic-v0"])
def test_names_and_env_ids_stand_for_a_system(spec, capsys):
    assert SYSTEMS.resolve(spec) is Academic
    assert SYSTEMS.resolve(f"pinnobs_gym:{spec}" if "/" in spec else spec) is Academic
    assert main(["tune", "ekf", "--system", spec, "--trials", "0"]) == 2
    assert "trials=0" in capsys.readouterr().err


def test_another_version_is_told_of():
    with pytest.raises(ValueError, match="that of Academic is pinnobs/Academic-v0"):
        SYSTEMS.resolve("pinnobs/Academic-v7")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["evalate"], "evaluate"),
        (["systems", "ReverseDufing"], "ReverseDuffing"),
        (["systems", "reverseduffing"], "ReverseDuffing"),
        (["estimators", "EKF"], "ekf"),
        (["train", "kkl_pin"], "kkl_pinn"),
        (["evaluate", "--system", "Academic", "--condition", "drpout10"], "dropout10"),
        (["evaluate", "--system", "Academic", "--setup", "papr"], "paper"),
        (["evaluate", "--system", "Academic", "--estmator", "ekf"], "--estimator"),
        (["evaluate", "--system", "Academic", "--set", "assumed_nose=1"], "assumed_noise"),
        (["train", "rl", "--system", "Academic", "--preset", "ppo_normalised"], "ppo_normalized"),
    ],
)
def test_a_near_miss_is_told(arguments, meant, capsys):
    assert main(arguments) == 2
    assert f"did you mean {meant!r}?" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["policy:agent", "agent.zip", "policy:"])
def test_how_an_agents_file_is_named_is_told(name, capsys):
    assert main(["evaluate", "--system", "Academic", "--estimator", name]) == 2
    assert "is given by policy:FILE.zip" in capsys.readouterr().err


def test_the_training_that_an_estimator_needs_is_told_as_a_command(capsys):
    assert main(["evaluate", "--system", "Academic", "--estimator", "kkl_pinn"]) == 2
    command = capsys.readouterr().err.partition("trained first: pinnobs ")[2].partition(";")[0]
    assert main([*command.split(), "--budget", "0"]) == 2  # all else of it is accepted
    assert "budget=0.0; expected" in capsys.readouterr().err


def test_what_is_like_nothing_has_no_guess():
    assert did_you_mean("dance", COMMANDS) == ""
    assert did_you_mean(3, COMMANDS) == ""


def test_settings_of_an_estimator_have_defaults_and_meanings(capsys):
    found = {name: (default, meaning) for name, default, meaning in settings(EKF)}
    assert found["patience"] == ("15", "How many samples in a row may be beyond the gate.")
    for cls in ESTIMATORS.classes().values():
        for name, default, meaning in settings(cls):
            assert name.isidentifier()
            assert default
            assert meaning
    assert main(["estimators", "open_loop"]) == 0
    assert "no settings" in capsys.readouterr().out


def test_an_estimator_without_docstring_is_not_described_by_its_signature(tmp_path, capsys):
    (tmp_path / "undescribed.py").write_text(UNDESCRIBED)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        assert main(["estimators", "undescribed:Mine"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[:3] == ["(no docstring)", "", "track: online; knows: model, prior, noise"]
    assert lines[-2:] == [
        "  rate=60.0",
        "next: pinnobs evaluate --system ReverseDuffing --estimator undescribed:Mine",
    ]


def test_texts_for_people_have_no_markup_of_code_and_no_names_of_constants(capsys):
    assert main(["train", "--help"]) == 0
    assert "`" not in capsys.readouterr().out
    assert main(["systems", "Academic"]) == 0
    assert f"over {LARGEST_CORRECTION:g} times the typical error" in capsys.readouterr().out


def test_a_rows_file_is_named_once(tmp_path, monkeypatch, capsys):
    """Where an estimator is shown among those of the file that it is written to."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pinnobs_gym.cli.console.table_width", lambda: 80)
    command = ["evaluate", "--system", "Academic", "--episodes", "2", "--out", "ev"]
    assert main(command) == 0
    capsys.readouterr()
    assert main([*command, "--estimator", "ukf", "--against", "ev/rows.jsonl"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "(pinnobs tables ev/rows.jsonl -o FILE writes all)" in said


@pytest.mark.parametrize(
    "arguments", [["systems"], ["estimators"], ["systems", "Academic"], ["estimators", "ekf"]]
)
def test_a_command_ends_with_the_next_one(arguments, capsys):
    assert main(arguments) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: pinnobs ")


def test_a_notebooks_cell_is_no_terminal(monkeypatch, capsys):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    for name in ("JPY_PARENT_PID", "MPLBACKEND"):
        monkeypatch.delenv(name, raising=False)
    assert in_terminal()
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    assert not in_terminal()
    monkeypatch.delenv("JPY_PARENT_PID")
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    assert not in_terminal()
    with shown_progress() as show:  # and what takes less than the time between lines prints none
        for k in range(1000):
            show(k / 1000, "step")
    assert capsys.readouterr().out == ""


CELL = """
import os, pty, sys
status = pty.spawn([sys.executable, "-m", "pinnobs_gym.cli", *sys.argv[1:]])
sys.exit(os.waitstatus_to_exitcode(status))
"""


def test_a_notebooks_command_prints_few_lines(tmp_path):
    """As its kernel runs it: in a terminal of its own, and told to use colours."""
    kernel = {"JPY_PARENT_PID": "1", "TERM": "xterm-color", "FORCE_COLOR": "1", "CLICOLOR": "1"}
    command = ["evaluate", "--system", "Academic", "--episodes", "3", "--out", str(tmp_path)]
    done = subprocess.run(
        [sys.executable, "-c", CELL, *command],
        env=os.environ | kernel,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
    )
    assert done.returncode == 0, done.stdout
    assert "\x1b" not in done.stdout
    assert done.stdout.count("\n") < 40
    assert done.stdout.count("episodes") < 4
