"""Records for other languages, and the scores of what is brought back, as a user meets them."""

import csv
import json
import math
import os
import re
import shutil
import subprocess
from dataclasses import dataclass

import numpy as np
import pytest
from snippets import ROOT, blocks

from pinnobs_gym import Setup, System, evaluate, read_rows
from pinnobs_gym.cli import main
from pinnobs_gym.cli.model_code import equations_text, matlab_model
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.files.seal import sealed
from pinnobs_gym.scoring.metrics import SCORES
from pinnobs_gym.scoring.submitted import check_name
from pinnobs_gym.simulation.system import stack
from pinnobs_gym.systems import SYSTEMS


def run(*arguments):
    """The exit status of the command, also where the parser ends it."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def error(capsys):
    """What the command said in its one line."""
    (line,) = capsys.readouterr().err.splitlines()
    return line.removeprefix("pinnobs: error: ")


def read(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write_ekf(path, game, seeds, std=False):
    """Write the estimates of the package's own filter. Returns its standard deviations."""
    record, names = game.record(seeds), game.source.system.state_names
    estimates = EKF.for_setup(game.source.system, game.source.setup).run(record)
    deviations = np.sqrt(np.einsum("bkii->bki", estimates.P))
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["episode", "t", *names, *(f"{n}_std" for n in names if std)])
        for i, seed in enumerate(seeds):
            own = [estimates.xhat[i], deviations[i]] if std else [estimates.xhat[i]]
            values = np.concatenate(own, axis=1).tolist()
            writer.writerows([seed, t, *x] for t, x in zip(record.t.tolist(), values, strict=True))


@pytest.mark.parametrize("condition", ["nominal", "dropout30"])
def test_records_are_those_of_the_game_with_all_digits_and_without_the_truth(folder, condition):
    arguments = ("--system", "InductionMotor", "--condition", condition, "--episodes", 2)
    assert run("episodes", *arguments, "--seed", 3, "-o", "motor") == 0
    names = ["README.md", "game.json", "model.m", "records.csv"]
    assert sorted(os.listdir(folder)) == ["motor"]
    assert sorted(os.listdir(folder / "motor")) == names
    game = Game.of("InductionMotor", "benchmark", condition)
    record, lines = game.record([3, 4]), read(folder / "motor/records.csv")
    assert list(lines[0]) == ["episode", "t", "y1", "y2", "u1", "u2"]
    assert [line["episode"] for line in lines] == ["3"] * 1000 + ["4"] * 1000
    table = np.array([[float(v or "nan") for v in line.values()] for line in lines])
    np.testing.assert_array_equal(table[:, 1], np.tile(record.t, 2))
    np.testing.assert_array_equal(table[:, 2:4], record.y.reshape(-1, 2))
    np.testing.assert_array_equal(table[:, 4:], record.u.reshape(-1, 2))
    facts = json.loads((folder / "motor/game.json").read_text(encoding="utf-8"))
    assert facts["prior_mean"] == record.prior.mean[0].tolist()
    assert facts["prior_covariance"] == record.prior.cov[0].tolist()
    assert facts["output_noise_covariance"] == [[0.25, 0.0], [0.0, 0.25]]
    assert not np.any(facts["process_noise_covariance"])
    text = (folder / "motor/README.md").read_text(encoding="utf-8")
    for said in ("| R_s | 0.18 | Stator resistance (Ω). |", "| state | omega | rad/s | 270 |"):
        assert said in text
    assert "u1(t) = u1_amplitude*cos(t*u_frequency)" in text
    assert ("30 % of the outputs missing" in text) == (condition == "dropout30")


def test_records_that_are_not_as_they_were_written_are_not_taken_for_them(folder, capsys):
    command = ("episodes", "--system", "ReverseDuffing", "--episodes", 1, "-o", "records")
    assert run(*command) == 0
    table = folder / "records/records.csv"
    for damage in (lambda: table.write_text("episode,t,y1\n"), table.unlink):
        damage()
        capsys.readouterr()
        assert run(*command) == 2
        assert error(capsys).startswith("records/records.csv is missing or not as it was written")


@pytest.mark.parametrize("name", ["ekf", "ekf, tuned", "ukf (fast)", "exact_bayes"])
def test_a_submission_has_a_name_of_its_own(name):
    with pytest.raises(ValueError, match="is that of an estimator of this package"):
        check_name(name)


def test_every_system_has_a_folder_and_the_same_again_is_said(folder, capsys):
    assert run("episodes", "--episodes", 1, "-o", "all") == 0
    assert sorted(os.listdir(folder / "all")) == sorted(SYSTEMS.sources)
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*.*")}
    assert "there already" not in capsys.readouterr().out
    assert run("episodes", "--episodes", 1, "-o", "all") == 0
    assert capsys.readouterr().out.count("they were there already") == len(SYSTEMS.sources)
    assert before == {path: path.stat().st_mtime_ns for path in folder.rglob("*.*")}


def test_of_episodes_that_are_all_the_same_one_is_written(folder, capsys):
    assert run("episodes", "--system", "ReverseDuffing", "--setup", "paper", "-o", "a") == 0
    assert "every episode of setup 'paper' is the same: 1 is written" in capsys.readouterr().out
    assert {line["episode"] for line in read(folder / "a/records.csv")} == {"0"}


def test_the_truth_is_written_of_training_episodes_alone(folder, capsys):
    assert run("episodes", "--system", "Academic", "--with-truth", "--episodes", 2, "-o", "a") == 0
    game, seeds = Game.of("Academic"), [10**6, 10**6 + 1]
    lines = read(folder / "a/truth.csv")
    assert list(lines[0]) == ["episode", "t", "x1", "x2"]
    truth = np.array([[float(line["x1"]), float(line["x2"])] for line in lines])
    x = game.episodes(seeds).x[:-1].swapaxes(0, 1)
    np.testing.assert_array_equal(truth, x.reshape(-1, 2))
    write_ekf(folder / "a/estimates.csv", game, seeds)
    capsys.readouterr()
    assert run("score", "a/estimates.csv", "--name", "mine", "--track", "online") == 2
    assert "episode 1000001 is one for training" in error(capsys)
    arguments = ("--system", "Academic", "--with-truth", "--seed", 5)
    assert run("episodes", *arguments, "-o", "b") == 2
    assert error(capsys).startswith("seed=5 with the truth; expected at least 1000000")
    assert not (folder / "b").exists()


def test_a_folder_with_anything_else_is_left_as_it_is(folder, capsys):
    (folder / "mine").mkdir()
    (folder / "mine/notes.txt").write_text("mine")
    (folder / "file").write_text("mine")
    assert run("episodes", "--system", "Academic", "--episodes", 1, "-o", "a") == 0
    for out, episodes, said in (
        ("mine", 1, "folder mine holds other files; expected a new folder"),
        ("file", 1, "file is a file; expected a new folder"),
        ("a", 2, "folder a holds other records (episodes differ); expected a new folder"),
    ):
        capsys.readouterr()
        assert run("episodes", "--system", "Academic", "--episodes", episodes, "-o", out) == 2
        assert error(capsys) == said
    assert sorted(os.listdir(folder)) == ["a", "file", "mine"]
    assert os.listdir(folder / "mine") == ["notes.txt"]


def test_a_folder_is_written_whole_or_not_at_all(folder, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pinnobs_gym.scoring.episode_folder._columns", stop)
    assert run("episodes", "--system", "Academic", "--episodes", 1, "-o", "a") == 130
    assert os.listdir(folder) == []


@pytest.mark.parametrize(
    ("system", "condition"), [("ReverseDuffing", "nominal"), ("Satellite", "dropout30")]
)
def test_estimates_brought_back_have_the_scores_of_evaluate(folder, system, condition, capsys):
    arguments = ("--system", system, "--condition", condition)
    assert run("episodes", *arguments, "--episodes", 3, "-o", "records") == 0
    game = Game.of(system, "benchmark", condition)
    write_ekf(folder / "records/mine.csv", game, range(3), std=True)
    score = ("score", "records/mine.csv", "--name", "my observer", "--track", "offline")
    assert run(*score, "--knows", "model", "--out", "runs") == 0
    assert "whether the estimates are causal cannot be checked" in capsys.readouterr().out
    rows = read_rows("runs/rows.jsonl")
    own = evaluate("ekf", game.name.env_id, condition=condition, episodes=3)
    for row, expected in zip(rows, own, strict=True):
        same = (*SCORES, "state_rmse", "diverged", "reference_steady", "coverage", "game_hash")
        assert {name: row[name] for name in same} == {name: expected[name] for name in same}
        assert (row["estimator"], row["track"]) == ("my observer", "offline, submitted")
        assert row["knows"] == ["submitted", "model"]
        assert row["us_per_step"] is None
        assert row["nis"] is None
        assert row["anees"] > 0
    assert run(*score, "--knows", "model", "--out", "runs") == 0
    assert "3 of 3 episodes taken from runs/rows.jsonl" in capsys.readouterr().out
    assert "us_per_step" not in (folder / "runs/rows.jsonl").read_text()
    assert math.isnan(rows.to_pandas()["us_per_step"].iloc[0])


def extended_kalman_filter(samples, mean, cov, R, dt):
    """The filter of the guide in plain Python, for the harmonic oscillator: x3 is the squared
    frequency, so that a step of the model has a closed form; its Jacobian is by differences."""

    def step(x):
        if x[2] <= 0:
            w = math.sqrt(-x[2]) or 1e-9
            c, s = math.cosh(w * dt), math.sinh(w * dt)
            return [c * x[0] + s / w * x[1], w * s * x[0] + c * x[1], x[2]]
        w = math.sqrt(x[2])
        c, s = math.cos(w * dt), math.sin(w * dt)
        return [c * x[0] + s / w * x[1], -w * s * x[0] + c * x[1], x[2]]

    episode, x, P = None, [], []
    for sample in samples:
        if sample["episode"] != episode:
            episode, x, P = sample["episode"], list(mean), [list(row) for row in cov]
        else:
            columns = []
            for j in range(3):
                up, down = ([v + s * (i == j) for i, v in enumerate(x)] for s in (1e-6, -1e-6))
                columns.append([(a - b) / 2e-6 for a, b in zip(step(up), step(down), strict=True)])
            F = [list(row) for row in zip(*columns, strict=True)]
            FP = [[sum(F[i][k] * P[k][j] for k in range(3)) for j in range(3)] for i in range(3)]
            P = [[sum(FP[i][k] * F[j][k] for k in range(3)) for j in range(3)] for i in range(3)]
            x = step(x)
        if sample["y1"]:
            K = [P[i][0] / (P[0][0] + R) for i in range(3)]
            innovation = float(sample["y1"]) - x[0]
            x = [v + k * innovation for v, k in zip(x, K, strict=True)]
            P = [[P[i][j] - K[i] * P[0][j] for j in range(3)] for i in range(3)]
        yield [episode, sample["t"], *x]


def test_a_filter_that_knows_the_files_alone_scores_as_the_packages_own(folder):
    arguments = ("--system", "HarmonicOscillator", "--condition", "dropout30")
    assert run("episodes", *arguments, "--episodes", 2, "-o", "records") == 0
    facts = json.loads((folder / "records/game.json").read_text(encoding="utf-8"))
    prior = facts["prior_mean"], facts["prior_covariance"]
    level, dt = facts["output_noise_covariance"][0][0], facts["sample_time"]
    estimates = extended_kalman_filter(read(folder / "records/records.csv"), *prior, level, dt)
    with (folder / "records/estimates.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["episode", "t", *facts["states"]])
        writer.writerows(estimates)
    score = ("score", "records/estimates.csv", "--name", "mine", "--track", "online")
    assert run(*score, "--out", "runs") == 0
    env_id, exact = "pinnobs/HarmonicOscillator-v0", {"assumed_noise": 0.0}
    own = evaluate("ekf", env_id, condition="dropout30", episodes=2, options=exact)
    for row, expected in zip(read_rows("runs/rows.jsonl"), own, strict=True):
        for name in ("nrmse", "nrmse_transient", "nrmse_steady", "nrmse_tail"):
            assert row[name] == pytest.approx(expected[name], rel=1e-4)


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_c_program_of_the_guide_scores_as_the_packages_own(folder):
    assert run("episodes", "--system", "ReverseDuffing", "--episodes", 2, "-o", "records") == 0
    ((_, text),) = blocks(ROOT / "docs/guides/other_languages.md", "c")
    (folder / "ekf.c").write_text(text)
    subprocess.run(["cc", "-O1", "ekf.c", "-o", "ekf", "-lm"], check=True)
    with (
        (folder / "records/records.csv").open() as records,
        (folder / "records/estimates.csv").open("w") as estimates,
    ):
        subprocess.run([folder / "ekf"], stdin=records, stdout=estimates, check=True)
    score = ("score", "records/estimates.csv", "--name", "in C", "--track", "online")
    assert run(*score, "--out", "runs") == 0
    own = evaluate("ekf", "pinnobs/ReverseDuffing-v0", episodes=2, options={"assumed_noise": 0.0})
    for row, expected in zip(read_rows("runs/rows.jsonl"), own, strict=True):
        for name in ("nrmse", "nrmse_transient", "nrmse_steady"):
            assert row[name] == pytest.approx(expected[name], rel=1e-3)


def in_python(code):
    """The functions of ``model.m`` by name, translated: its operators are those of Python but for
    the dots, and a matrix is a dict of entries."""
    functions = {}
    for name, body in re.findall(r"function out_ = (\w)_of\(.*?\)\n(.*?)\nend", code, re.S):
        lines = []
        for line in body.splitlines():
            text = line.strip().rstrip(";").replace(".*", "*").replace("./", "/")
            text = text.replace(".^", "**").replace("^", "**")
            if text.startswith("out_ = zeros"):
                text = "out_ = np." + re.sub(r"\((\d+), (\d+)\)", r"((\1, \2))", text[7:])
            text = re.sub(
                r"out_\((\d+), (\d+)\)", lambda m: f"out_[{int(m[1]) - 1}, {int(m[2]) - 1}]", text
            )
            text = re.sub(r"\b([xu]_)\((\d+)\)", lambda m: f"{m[1]}[{int(m[2]) - 1}]", text)
            lines.append(text)
        space = {"np": np, "sqrt": np.sqrt, "cos": np.cos, "sin": np.sin}
        arguments = "t" if name == "u" else "t, x_, u_"
        source = f"def {name}({arguments}):\n    " + "\n    ".join(lines) + "\n    return out_"
        exec(source, space)
        functions[name] = space[name]
    return functions


@pytest.mark.parametrize("name", SYSTEMS.sources)
def test_model_m_is_the_model(name):
    system, _ = SYSTEMS.resolve(name).configured()
    code = matlab_model(system, {})
    assert code is not None
    made, rng = in_python(code), np.random.default_rng(1)
    for _ in range(3):
        t, x = float(rng.uniform(0, 1)), rng.uniform(-2, 2, system.nx)
        u = np.asarray(system.input(np.array(t)))
        expected = {"f": system.f, "h": system.h, "F": system.f_jacobian, "H": system.h_jacobian}
        for part, function in expected.items():
            value = np.asarray(function(t, x, u))
            np.testing.assert_allclose(
                made[part](t, x, u), value.reshape(len(value), -1), rtol=1e-12, atol=1e-12
            )
        if system.nu:
            np.testing.assert_allclose(made["u"](t)[:, 0], u, rtol=1e-12)


@dataclass(frozen=True)
class Clash(System):
    """A plant whose names are those that the code of MATLAB needs itself."""

    state_names = ("x", "t")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {"benchmark": Setup((-1, -1), (1, 1), duration=1, dt=0.1)}

    def f(self, t, x, u):
        return stack(x, -x[..., 1], x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]


@dataclass(frozen=True)
class Interpolated(Clash):
    """A plant that cannot be traced."""

    state_names = ("a", "b")

    def f(self, t, x, u):
        return stack(x, np.interp(np.asarray(x[..., 1], dtype=float), (-1, 1), (1, -1)), 0.0)


def test_there_is_no_model_m_where_it_would_not_be_the_model():
    assert matlab_model(Clash(), {}) is None
    assert equations_text(Clash()) == "d(x)/dt = -t\nd(t)/dt = x\ny = x"
    assert matlab_model(Interpolated(), {}) is None
    with pytest.raises(ValueError, match="Interpolated cannot be traced"):
        equations_text(Interpolated())


def changed(line, cell, value):
    """The lines of a table with another cell, or without the line."""

    def change(lines):
        if value is None:
            return [*lines[:line], *lines[line + 1 :]]
        cells = lines[line].split(",")
        cells[cell] = value
        return [*lines[:line], ",".join(cells), *lines[line + 1 :]]

    return change


NUMBER = "expected a number, or inf where the estimate has diverged"
WRONG = {
    "a missing column": (
        lambda lines: [line.rpartition(",")[0] for line in lines],
        "bad.csv has no column x2; it has episode, t, x1",
    ),
    "an unknown column": (
        changed(0, 3, "X_2"),
        "bad.csv has a column 'X_2' (did you mean 'x2'?); expected episode, t, x1, x2 and, "
        "optionally, x1_std, x2_std",
    ),
    "a column twice": (changed(0, 3, "x1"), "bad.csv has column 'x1' twice"),
    "some standard deviations": (
        lambda lines: [f"{lines[0]},x1_std", *(f"{line},1" for line in lines[1:])],
        "bad.csv has no column x2_std; it has episode, t, x1, x2, x1_std",
    ),
    "a missing episode": (
        lambda lines: lines[:501],
        "bad.csv lacks episode 1 and 1 more; expected all from 0 to 2",
    ),
    "another episode": (
        changed(1, 0, "7"),
        "bad.csv, line 2: episode=7; the records have the episodes 0 to 2",
    ),
    "no episode": (changed(1, 0, "1.5"), "bad.csv, line 2: episode='1.5'; expected a whole number"),
    "a missing sample": (
        changed(502, 0, None),
        "bad.csv, line 503: t=0.04 is sample 1 of episode 1; expected t=0.02, the times of the "
        "records in their order",
    ),
    "a missing last sample": (
        changed(1500, 0, None),
        "bad.csv: episode 2 ends after 499 samples; expected 500, the next of t=9.98",
    ),
    "a sample twice": (
        lambda lines: [*lines, lines[-1]],
        "bad.csv, line 1502: t=9.98 comes after the last sample of episode 2; expected 500 samples,"
        " to t=9.98",
    ),
    "two samples in another order": (
        lambda lines: [*lines[:2], lines[3], lines[2], *lines[4:]],
        "bad.csv, line 3: t=0.04 is sample 1 of episode 0; expected t=0.02, the times of the "
        "records in their order",
    ),
    "a shifted time": (
        changed(3, 1, "0.0401"),
        "bad.csv, line 4: t=0.0401 is sample 2 of episode 0; expected t=0.04, the times of the "
        "records in their order",
    ),
    "no time": (changed(3, 1, "inf"), "bad.csv, line 4: t='inf'; expected a finite number"),
    "an empty cell": (changed(3, 3, ""), f"bad.csv, line 4: x2=''; {NUMBER}"),
    "no number": (changed(3, 3, "NaN"), f"bad.csv, line 4: x2='NaN'; {NUMBER}"),
    "text": (changed(3, 3, "1_0"), f"bad.csv, line 4: x2='1_0'; {NUMBER}"),
    "other digits": (changed(3, 3, "１"), f"bad.csv, line 4: x2='１'; {NUMBER}"),
    "a number beyond doubles": (changed(3, 3, "1e400"), f"bad.csv, line 4: x2='1e400'; {NUMBER}"),
    "a stray quote": (
        lambda lines: [*lines[:3], '0,0.04,0.5,"1', *lines[4:]],
        "estimates bad.csv, line 4: '0,0.04,0.5,\"1' is no line of a CSV file (unexpected end of "
        "data); expected every quote to be closed in its line",
    ),
    "a cell too many": (changed(3, 3, "1,2"), "bad.csv, line 4: 5 cells; expected 4"),
    "a header alone": (
        lambda lines: lines[:1],
        "bad.csv has no rows; expected a header and a line per sample",
    ),
}


@pytest.fixture(scope="module")
def submitted(tmp_path_factory):
    """A folder of records with the file ``estimates.csv``."""
    folder = tmp_path_factory.mktemp("submitted")
    assert run("episodes", "--system", "Academic", "--episodes", 3, "-o", folder / "records") == 0
    write_ekf(folder / "records/estimates.csv", Game.of("Academic"), range(3))
    return folder / "records"


def score(path, records, *arguments):
    return run("score", path, "--name", "m", "--track", "online", "--records", records, *arguments)


@pytest.mark.parametrize("case", WRONG)
def test_a_wrong_file_is_refused_in_one_line(folder, submitted, capsys, case):
    change, said = WRONG[case]
    lines = (submitted / "estimates.csv").read_text().splitlines()
    (folder / "bad.csv").write_text("\n".join(change(lines)) + "\n")
    assert score("bad.csv", submitted) == 2
    assert error(capsys) == said
    assert os.listdir(folder) == ["bad.csv"]


def test_episodes_in_any_order_and_times_of_few_digits_are_taken(folder, submitted):
    header, *lines = (submitted / "estimates.csv").read_text().splitlines()
    moved = [*lines[1000:], "", *lines[:1000]]
    cells = [line.split(",") for line in moved]
    short = [",".join([f"{c[0]}.0", f"{float(c[1]):.5g}", *c[2:]]) if c[0] else "" for c in cells]
    (folder / "moved.csv").write_text("\ufeff" + "\r\n".join([header, *short]))
    assert score("moved.csv", submitted, "--out", "a") == 0
    assert score(submitted / "estimates.csv", submitted, "--out", "b") == 0
    one, other = (read_rows(f"{out}/rows.jsonl") for out in "ab")
    assert [row["nrmse"] for row in one] == [row["nrmse"] for row in other]
    assert one[0]["options"] == other[0]["options"]  # the estimates are the same


def test_an_infinite_estimate_is_a_diverged_episode(folder, submitted):
    lines = (submitted / "estimates.csv").read_text().splitlines()
    (folder / "lost.csv").write_text("\n".join(changed(700, 2, "-Inf")(lines)))
    assert score("lost.csv", submitted, "--out", "a") == 0
    rows = read_rows("a/rows.jsonl")
    assert [row["diverged"] for row in rows] == [False, True, False]
    assert rows[1]["nrmse"] == math.inf


def test_records_of_other_code_are_refused(folder, submitted, capsys):
    shutil.copytree(submitted, folder / "records")
    path = folder / "records/game.json"
    facts = json.loads(path.read_text(encoding="utf-8"))
    for change, said in (
        ({"game_hash": "0123456789"}, "the records in records are of other code or settings"),
        (
            {"env_id": "pinnobs/Mine-v0"},
            "pinnobs/Mine-v0, which is not known here; give the system",
        ),
        ({"episodes": "3"}, "episodes='3'; it is not as it was written"),
        ({"format": 9}, "is no file of pinnobs episodes of format 1"),
    ):
        path.write_text(json.dumps(sealed(facts | change)))
        assert score("records/estimates.csv", "records") == 2
        assert said in error(capsys)
    path.write_text(json.dumps(facts | {"first_episode": 1}))
    assert score("records/estimates.csv", "records") == 2
    assert "game.json: its values are not those that were written" in error(capsys)
    path.unlink()
    assert score("records/estimates.csv", "records") == 2
    assert error(capsys).startswith(f"there is no {path.relative_to(folder)}; expected a folder")


def test_names_of_estimators_here_are_not_given_away(folder, submitted, capsys):
    arguments = ("--track", "online", "--records", submitted)
    for name in ("ekf", "ekf (mine)", " mine"):
        assert run("score", submitted / "estimates.csv", "--name", name, *arguments) == 2
        assert error(capsys).startswith(f"name={name!r}")
    assert run("score", submitted / "estimates.csv", "--name", "", *arguments) == 2
    assert error(capsys).startswith("--name '' is empty; expected")


def test_records_and_estimates_in_parquet(folder, capsys):
    arguments = ("--system", "Academic", "--condition", "dropout30", "--format", "parquet")
    try:
        import pyarrow.parquet as parquet
    except ImportError:
        assert run("episodes", *arguments, "-o", "records") == 2
        assert error(capsys).endswith('install it with pip install "pinnobs-gym[parquet]"')
        pytest.skip("no PyArrow")
    assert run("episodes", *arguments, "--episodes", 2, "-o", "records") == 0
    game = Game.of("Academic", "benchmark", "dropout30")
    table = parquet.read_table("records/records.parquet")
    y = np.array(table.column("y1").to_pylist(), dtype=float)
    np.testing.assert_array_equal(y, game.record(range(2)).y.ravel())
    write_ekf(folder / "estimates.csv", game, range(2))
    assert score("estimates.csv", "records", "--out", "a") == 0
    with (folder / "estimates.csv").open(newline="") as file:
        header, *lines = csv.reader(file)
    columns = np.array(lines, dtype=float).T
    import pyarrow

    made = pyarrow.table(dict(zip(header, columns, strict=True)))
    parquet.write_table(made, "estimates.parquet")
    assert score("estimates.parquet", "records", "--out", "b") == 0
    one, other = (read_rows(f"{out}/rows.jsonl") for out in "ab")
    assert [row["nrmse"] for row in one] == [row["nrmse"] for row in other]
    (folder / "broken.parquet").write_text("no table")
    assert score("broken.parquet", "records") == 2
    assert "cannot read broken.parquet: " in error(capsys)


def test_a_system_of_ones_own_is_named_again_at_scoring(folder, capsys, monkeypatch):
    monkeypatch.syspath_prepend(str(folder))
    text = blocks(ROOT / "README.md", "python")
    source = next(block for _, block in text if "class VanDerPol" in block)
    source = source.partition("\nenv = ")[0]
    (folder / "van_der_pol_of_mine.py").write_text(source, encoding="utf-8")
    spec = "van_der_pol_of_mine:VanDerPol"
    assert run("episodes", "--system", spec, "--episodes", 1, "-o", "records") == 0
    said = f'pinnobs score estimates.csv --name "my observer" --track online --system {spec}'
    assert said in (folder / "records/README.md").read_text(encoding="utf-8")
    write_ekf(folder / "estimates.csv", Game.of(spec), [0])
    assert score("estimates.csv", "records", "--system", spec, "--out", "runs") == 0
    assert score("estimates.csv", "records", "--system", "Academic") == 2
    assert "system='Academic' is pinnobs/Academic-v0" in error(capsys)
