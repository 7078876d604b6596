"""The command that writes estimators as C."""

import subprocess

import numpy as np
import pytest
from exported import COMPILER, FLAGS, csv_of, needs_c, replay
from linear import record_of

from pinnobs_gym.cli import main
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimators.ekf import EKF


def run(*arguments):
    return main([str(a) for a in arguments])


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def motor(tmp_path_factory):
    """A program that replays logs of the motor with measured inputs."""
    folder = tmp_path_factory.mktemp("motor")
    given = ("--system", "InductionMotor", "--measured-input", "--out", folder / "motor.c")
    assert run("export", "ekf", *given) == 0
    files = [folder / "motor.c", folder / "motor_replay.c"]
    subprocess.run([COMPILER, *FLAGS, *files, "-lm", "-o", folder / "replay"], check=True)
    return folder / "replay"


@needs_c
def test_its_files_compile_and_replay_a_log(folder, capsys):
    given = ("--system", "ReverseDuffing", "--noise-std", 0.2, "--xhat0", 0.5, -0.5)
    assert run("export", "ekf", *given, "-o", "duffing.c", "--set", "assumed_noise=0.01") == 0
    said = capsys.readouterr().out
    command = [COMPILER, *FLAGS, "duffing.c", "duffing_replay.c", "-lm", "-o", "replay"]
    subprocess.run(command, check=True)
    assert "cc -std=c99 -O2 duffing.c duffing_replay.c -lm" in said
    source = EpisodeSource("ReverseDuffing", noise_std=0.2)
    record = record_of(source, 1).first_samples(50)
    found, _ = replay(folder / "replay", csv_of(record, source.system))
    own = EKF.for_setup(source.system, source.setup, assumed_noise=0.01)
    record.prior.mean[:] = 0.5, -0.5
    np.testing.assert_allclose(found[:, 1:3], own.run(record).xhat[0], atol=1e-12)


@needs_c
@pytest.mark.parametrize(
    ("header", "says"),
    [
        ("t,y1,y2,u1,u2", ""),
        ('\ufefft, y1 ,"y2",u1,u2\r', ""),
        ("t,y2,y1,u1,u2", "line 1: column 2 is not named y1; expected"),
        ("t,u1,u2,y1,y2", "line 1: column 2 is not named y1; expected"),
        ("t,y1,y2,u1", "line 1: column 5 is not named u2; expected"),
        ("0,1,2,3,4", "line 1: column 1 is not named t; expected"),
        ("t,y1,y2,u1,u2,u3", "line 1: more than 5 columns; expected only"),
        (None, "the file is empty; expected a line of names"),
    ],
)
def test_the_program_reads_a_log_whose_columns_are_named_in_order(header, says, motor, folder):
    text = "" if header is None else f"{header}\n0,1,2,3,4\n"
    found = subprocess.run([motor], input=text, capture_output=True, text=True, check=False)
    assert (says in found.stderr) if says else not found.stderr
    assert found.returncode == bool(says)
    assert len(found.stdout.splitlines()) == (not says)


def test_measured_inputs(folder):
    assert run("export", "ekf", "--system", "InductionMotor", "--out", "own.c") == 0
    assert (
        run("export", "ekf", "--system", "InductionMotor", "--out", "given.c", "--measured-input")
        == 0
    )
    assert "#define OWN_INPUTS 0" in (folder / "own.h").read_text()
    assert "#define GIVEN_INPUTS 2" in (folder / "given.h").read_text()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "name an estimator first: pinnobs export ekf"),
        (["ekf", "--system", "Academic", "--out", "a.py"], "out=a.py; expected the name of a C"),
        (["ekf", "--system", "Academic", "--out", "b.c"], "b.h already exists; expected"),
        (["ekf", "--system", "Academic", "--out", "2a.c"], "name='2a'; expected a name in C"),
        (["ekf", "--system", "Academic", "--out", "filter.c"], "filter is taken by C or the code"),
        (["mhe", "--system", "Academic", "--out", "a.c"], "estimator 'mhe' is not exported"),
        (["kkl_pinn", "--system", "Academic", "--out", "a.c"], "give the file with --trained FILE"),
        (
            ["ekf", "--system", "Academic", "--out", "a.c", "--trained", "a.pt"],
            "trained=a.pt: estimator 'ekf' is not trained",
        ),
        (
            [
                "kkl_pinn",
                "--system",
                "Academic",
                "--out",
                "a.c",
                "--trained",
                "a.pt",
                "--set",
                "a=1",
            ],
            "set=a=1: the settings of 'kkl_pinn' are those of its trained file",
        ),
    ],
)
def test_bad_input_is_one_line(folder, capsys, arguments, message):
    (folder / "b.h").touch()
    assert run("export", *arguments) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert {path.name for path in folder.iterdir()} == {"b.h"}
