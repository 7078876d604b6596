"""Logs in the commands evaluate and train: what they print and write, and what they refuse."""

import re
from pathlib import Path

import numpy as np
import pytest
from driven_spring import Drive, DrivenSpring, write_csv

from pinnobs_gym.cli import main
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.log_evaluation import evaluate_logs

SPRING = ["--system", "driven_spring:DrivenSpring"]
ONE = ["--log", "a.csv", "--reference", "a-ref.csv"]
TWO = ["--log", "a.csv", "b.csv", "--reference", "a-ref.csv", "b-ref.csv"]


def run(*arguments):
    """The exit status of the command, also where the parser ends it."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with two logs of the same times and their references."""
    monkeypatch.chdir(tmp_path)
    for name, start in (("a", (0.9, 1.2)), ("b", (-0.5, 0.4))):
        drive = Drive(samples=30, start=start)
        drive.write_log(tmp_path / f"{name}.csv")
        times = np.linspace(drive.t[0], drive.t[-1], 25)
        drive.write_reference(tmp_path / f"{name}-ref.csv", times)
    return tmp_path


def rows_path(out="runs/evaluate"):
    return Path(out) / "rows.jsonl"


def stored():
    return rows.read(rows_path())


def test_estimators_are_ranked_on_ones_own_logs(folder, capsys):
    for name in ("ekf", "ukf"):
        assert run("evaluate", *SPRING, *TWO, "--estimator", name) == 0
    out = capsys.readouterr().out
    assert "pinnobs/DrivenSpring-v0, log, nominal" in out
    found = stored()
    assert [(row["estimator"], row["log"]) for row in found] == [
        ("ekf", "a.csv"), ("ekf", "b.csv"), ("ukf", "a.csv"), ("ukf", "b.csv"),
    ]  # fmt: skip
    own = evaluate_logs("ekf", DrivenSpring, ["a.csv", "b.csv"], ["a-ref.csv", "b-ref.csv"])
    assert [row["nrmse"] for row in found[:2]] == [row["nrmse"] for row in own]
    assert list(folder.glob("runs/evaluate/tensorboard/ekf/DrivenSpring-v0/*"))
    # All that reads rows, and compares estimators of the same logs.
    assert run("tables", rows_path()) == 0
    out = capsys.readouterr().out
    assert "DrivenSpring-v0, log" in out
    given = ["--estimator", "mhe", "--against", rows_path(), "--out", "other"]
    assert run("evaluate", *SPRING, *ONE, *given) == 0
    assert "of 3 estimators of the track online, on 1 episodes" in " ".join(
        capsys.readouterr().out.split()
    )
    assert run("evaluate", *SPRING, *TWO) == 0
    assert "2 of 2 episodes taken from" in capsys.readouterr().out


def test_the_page_shows_the_reference_and_the_commands(folder, capsys):
    pytest.importorskip("altair")
    pytest.importorskip("vl_convert")
    for name in "ab":
        (folder / f"{name}-ref.csv").write_text("t,v\n4,0.1\n5,\n6,0.2\n")
    assert run("evaluate", *SPRING, *TWO) == 0
    assert run("report", rows_path(), "-o", "site") == 0
    page = (folder / "site" / "index.html").read_text(encoding="utf-8")
    assert re.search(r"\(log [ab].csv\)", page)
    assert "</i>reference <i" in page
    where = "--system driven_spring:DrivenSpring --log a.csv b.csv --reference a-ref.csv"
    plain = re.sub(r"<span>(--[a-z-]+)</span>", r"\1", page)  # which keep options on one line
    assert f"pinnobs evaluate {where}" in plain


def test_the_options_of_a_log_are_those_of_estimate(folder, capsys):
    write_csv(folder / "ms.csv", ("ms", "q", "force"), *_columns(folder / "a.csv", 1000.0))
    told = ["--noise-std", 0.2, "--xhat0", 0.9, 1.2, "--P0-std", 0.1, 0.1, "--process-noise", 0.3]
    log = ["--log", "ms.csv", "--columns", "t=ms*1e-3", "--reference", "a-ref.csv"]
    assert run("evaluate", *SPRING, *log, *told) == 0
    (own,) = stored()
    assert run("evaluate", *SPRING, *ONE, *told, "--out", "again") == 0
    (same,) = rows.read(rows_path("again"))
    assert own["nrmse"] == pytest.approx(same["nrmse"], rel=1e-6)
    assert run("evaluate", *SPRING, *ONE, "--out", "again") == 0
    assert rows.read(rows_path("again"))[1]["nrmse"] != same["nrmse"]
    capsys.readouterr()
    assert run("tables", rows_path("again")) == 0
    left = "log, nominal are left out: they are of another noise or prior that estimators are told"
    assert left in capsys.readouterr().err


def test_unknown_constants_are_states_without_a_reference(folder):
    assert run("evaluate", *SPRING, *TWO, "--also", "damping=0.5,0.2", "bias_q=0,0.1") == 0
    found = stored()
    assert {row["env_id"] for row in found} == {"pinnobs/DrivenSpring_damping_bias_q-v0"}
    assert all(set(row["state_rmse"]["steady"]) == {"q", "v"} for row in found)
    assert [row["nx"] for row in found] == [2, 2]
    assert run("evaluate", *SPRING, *TWO, "--also", "damping=0.5,0.2", "bias_q=0,0.1") == 0
    assert len(stored()) == 2  # all were stored


def _columns(path, factor):
    table = np.genfromtxt(path, delimiter=",", names=True)
    return factor * table["t"], table["q"], table["force"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([*ONE, "--condition", "noise5"], "--condition and --log"),
        ([*ONE, "--setup", "benchmark"], "--setup and --log"),
        ([*ONE, "--seed", "0"], "--seed and --log"),
        ([*ONE, "--episodes", "100"], "--episodes and --log"),
        ([*ONE, "--video", "a.mp4"], "--video and --log"),
        ([*ONE, "--tuned"], "--tuned and --log"),
        (["--reference", "a-ref.csv"], "--reference without --log"),
        (["--log", "--reference", "a-ref.csv"], "--log without a file"),
        (["--noise-std", "0.1"], "--noise-std without --log"),
        (["--log", "a.csv"], "1 log(s) and 0 reference(s)"),
        (["--log", "a.csv", "b.csv", "--reference", "a-ref.csv"], "2 log(s) and 1 reference(s)"),
        ([*ONE, "--against", "published"], "--against published and --log"),
        ([*ONE, "--estimator", "pinn_gain"], "has to be trained first"),
        ([*ONE, "--trained", "published"], "estimator 'ekf' needs no training"),
        (["--log", "none.csv", "--reference", "a-ref.csv"], "none.csv"),
        (["--log", "a.csv", "--reference", "none.csv"], "none.csv"),
        (["--log", "a.csv", "--reference", "empty.csv"], "empty.csv"),
    ],
)
def test_mistakes_are_told_in_one_line(folder, capsys, arguments, expected):
    (folder / "empty.csv").write_text("t,q\n")
    assert run("evaluate", *SPRING, *arguments) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1


def test_a_training_on_a_log_serves_on_logs(folder, capsys):
    given = ["--log", "a.csv", "--out", "tr", "--noise-std", "0.07"]
    small = ["--iterations", "3", "--width", "4", "--depth", "1"]
    assert run("train", "pinn_obs", *SPRING, *given, *small) == 0
    out = capsys.readouterr().out
    assert "loss " in out
    assert "RMSE" not in out  # no state is known
    path = folder / "tr" / "DrivenSpring-logs-a-pinn_obs-seed0.pt"
    trained = TrainedNetwork.load(path, DrivenSpring())
    assert trained.condition == "logs"
    assert trained.noise_std == (0.07,)
    table = np.genfromtxt("a.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(trained.y[:, 0], table["q"])
    scored = [*TWO, "--estimator", "pinn_obs_replay", "--trained", path]
    assert run("evaluate", *SPRING, *scored) == 0
    row = stored()[0]
    assert "logs" in row["knows"]
    assert row["settings"]["trained_under"] == "logs"
    # The training goes on, on this log alone.
    assert run("train", "pinn_obs", *SPRING, *given, *small) == 2
    more = ["--iterations", "5", *small[2:]]
    assert run("train", "pinn_obs", *SPRING, *given, *more, "--resume") == 0
    assert TrainedNetwork.load(path, DrivenSpring()).iterations == 5
    (folder / "a.csv").write_bytes((folder / "b.csv").read_bytes())
    capsys.readouterr()
    assert run("train", "pinn_obs", *SPRING, *given, *more, "--resume") == 2
    assert "trained on another record" in capsys.readouterr().err


def test_a_gain_is_trained_on_several_logs(folder, capsys):
    table = _columns(folder / "a.csv", 1.0)
    t = 0.1 * np.arange(len(table[0]))
    for i in range(4):
        y = table[1] + 0.05 * np.random.default_rng(i).normal(size=len(t))
        write_csv(folder / f"g{i}.csv", ("t", "q", "force"), t, y, table[2])
    logs = ["--log", *(f"g{i}.csv" for i in range(4)), "--noise-std", "1", "--process-noise", "1"]
    small = ["--iterations", "1", "--width", "4", "--streams", "4", "--chunk", "5", "--out", "tr"]
    assert run("train", "pinn_gain", *SPRING, *logs, *small) == 0
    path = folder / "tr" / "DrivenSpring-logs-g0+3-pinn_gain-seed0.pt"
    assert path.exists()
    assert run("evaluate", *SPRING, *ONE, "--estimator", "pinn_gain", "--trained", path) == 0
    (row,) = stored()
    assert row["training"]["config"]["episodes"] == 4


@pytest.mark.parametrize(
    ("trainer", "arguments", "expected"),
    [
        ("kkl_supervised", ["--log", "a.csv"], "learns from episodes that it simulates"),
        ("pinn_obs", ["--log", "a.csv", "b.csv"], "2 logs are given; expected 1"),
        ("pinn_gain", ["--log", "a.csv"], "1 log is given"),
        ("pinn_gain", ["--log", "a.csv", "short.csv"], "30 and 2 samples"),
        ("pinn_gain", ["--log", "short.csv", "late.csv"], "late.csv, line 3: t=0.3; expected"),
        ("pinn_gain", ["--log", "a.csv", "b.csv"], "irregular"),
        ("pinn_gain", ["--log", "a.csv", "copy.csv"], "a.csv and copy.csv have the same outputs"),
        ("pinn_obs", ["--log", "a.csv", "--condition", "noise5"], "--condition and --log"),
        ("pinn_obs", ["--log", "a.csv", "--episode", "3"], "--episode and --log"),
        ("pinn_obs", ["--columns", "t=ms"], "--columns without --log"),
        ("pinn_obs", ["--log", "none.csv"], "none.csv"),
    ],
)
def test_mistakes_of_trainings_on_logs(folder, capsys, trainer, arguments, expected):
    (folder / "short.csv").write_text("t,q,force\n0,1,2\n0.1,1,2\n")
    (folder / "late.csv").write_text("t,q,force\n0,1,2\n0.3,1,2\n")
    (folder / "copy.csv").write_bytes((folder / "a.csv").read_bytes())
    assert run("train", trainer, *SPRING, *arguments) == 2
    told = capsys.readouterr().err
    assert expected in told
    assert told.count("\n") == 1
