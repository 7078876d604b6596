"""The command, as a user meets it: what it prints, writes and answers to mistakes."""

import csv
import os
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from waiting import PATIENCE, heed_ctrl_c, until

from pinnobs_gym.cli import main
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.systems import SYSTEMS

QUICK = ["--systems", "ReverseDuffing", "--episodes", "4", "--jobs", "1"]


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


def write_log(path, source, header=None):
    episodes = source.play(source.draw(source.streams([0])))
    record = source.record(episodes)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header or ["t", "y1"])
        writer.writerows(zip(record.t.tolist(), record.y[0, :, 0].tolist(), strict=True))
    return episodes, record


def test_estimate_is_the_same_path_as_a_record_from_an_env(folder, capsys):
    source = EpisodeSource("ReverseDuffing")
    _, record = write_log(folder / "log.csv", source)
    assert run("estimate", "--system", "ReverseDuffing", "--log", "log.csv") == 0
    with (folder / "estimates.csv").open() as file:
        header, *lines = csv.reader(file)
    innovations = ["y1_innovation", "y1_innovation_std"]
    assert header == ["t", "x1", "x2", "x1_std", "x2_std", *innovations]
    table = np.array(lines, dtype=float)
    own = EKF.for_setup(source.system, source.setup).run(record)
    np.testing.assert_allclose(table[:, 1:3], own.xhat[0], rtol=1e-12)
    np.testing.assert_allclose(table[:, 3] ** 2, own.P[0, :, 0, 0], rtol=1e-9)
    with Image.open(folder / "estimates.png") as picture:
        assert picture.size[0] > 500
    assert "estimates: estimates.csv; picture: estimates.png" in capsys.readouterr().out


def test_huge_outputs_are_told_in_one_line(folder, capsys, recwarn):
    (folder / "log.csv").write_text("t,y1\n0,0.1\n0.1,1e308\n0.2,-1e308\n")
    assert run("estimate", "--system", "HarmonicOscillator", "--log", "log.csv") == 2
    told = capsys.readouterr()
    assert not recwarn.list
    assert "log.csv, line 3: y1='1e308'; expected a number up to 1e+30" in told.err


def test_estimate_with_settings_prior_and_another_estimator(folder):
    write_log(folder / "log.csv", EpisodeSource("ReverseDuffing", duration=1.0))
    common = ("estimate", "--system", "ReverseDuffing", "--log", "log.csv")
    assert (
        run(*common, "--xhat0", 0, 0, "--P0-std", 2, 2, "--noise-std", 0.1, "--out", "a.csv") == 0
    )
    assert run(*common, "--set", "assumed_noise=1", "--out", "b.csv") == 0
    assert run(*common, "--estimator", "open_loop", "--out", "c.csv") == 0
    first = [(folder / name).read_text().splitlines() for name in ("a.csv", "b.csv", "c.csv")]
    assert first[0][-1] != first[1][-1]
    assert first[2][1] == "0.0,0.0,0.0"  # the initial estimate, untouched by the output


@pytest.mark.parametrize("level", [(0.3,), (0.3, 0.3), (0.1, 0.0)])
def test_estimate_with_process_noise(folder, level):
    """As an EKF that is told it; one number is that of every state."""
    source = EpisodeSource("ReverseDuffing", duration=1.0)
    _, record = write_log(folder / "log.csv", source)
    common = ("estimate", "--system", "ReverseDuffing", "--log", "log.csv")
    assert run(*common, "--process-noise", *level) == 0
    table = np.loadtxt(folder / "estimates.csv", delimiter=",", skiprows=1)
    told = level if len(level) == 2 else level[0]
    own = EKF.for_setup(source.system, replace(source.setup, process_noise=told)).run(record)
    np.testing.assert_allclose(table[:, 1:3], own.xhat[0], rtol=1e-12)
    without = EKF.for_setup(source.system, source.setup).run(record)
    assert abs(own.xhat - without.xhat).max() > 1e-4


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "--system", "Duffing"], "unknown system 'Duffing'; known are Academic"),
        (["evaluate", "--system", "Academic", "--estimator", "kf"], "unknown estimator 'kf'; know"),
        (["evaluate", "--system", "Academic", "--condition", "x"], "unknown condition 'x'; known"),
        (["evaluate", "--system", "Academic", "--setup", "x"], "unknown setup 'x' of Academic"),
        (["evaluate", "--system", "Academic", "--set", "x=1"], "setting 'x=1'; expected name=val"),
        (["evaluate", "--system", "Academic", "--trained", "x"], "is not one that is trained"),
        (["evaluate", "--system", "Academic", "--out", "file/x"], "cannot write"),
        (["systems", "Duffing"], "unknown system 'Duffing'"),
        (["train"], "name a trainer first: pinnobs train kkl_autoencoder | kkl_pinn | "),
        (
            ["train", "gpt", "--system", "Academic"],
            "unknown trainer 'gpt'; known are kkl_autoencoder, kkl_pinn, ",
        ),
        (["leaderboard", "--out", "file/x"], "cannot write to folder file/x"),
        (["leaderboard", "--jobs", "0"], "jobs=0"),
        (["leaderboard", "--backend", "dask"], "backend 'dask' without a scheduler; expected"),
        (["leaderboard", "--scheduler", "tcp://a:1"], "goes with --backend dask"),
        (
            ["leaderboard", "--backend", "dask", "--scheduler", "tcp://a:1", "--jobs", "2"],
            "jobs=2 with backend 'dask'",
        ),
        (["leaderboard", "--suite", "quik"], "unknown suite 'quik'; known are full, leaderboard,"),
        (["leaderboard", "--suite", "none.toml"], "cannot read suite none.toml: No such file"),
        (["leaderboard", "--condition", "load_step"], "needs a plant with a load torque"),
        (["estimate", "--system", "Academic", "--log", "none.csv"], "cannot read log none.csv"),
        (["estimate", "--system", "Academic", "--log", "bad.csv"], "has no column y1; Academic"),
        (["leaderboard", "--episodes", "0"], "episodes=0; expected at least 1"),
        (["leaderboard", "--estimators", "pinn_obs_direct"], "'pinn_obs_direct' knows one record"),
        (["estimate", "--system", "Academic", "--log", "a.csv", "--out", "a.csv"], "overwrite"),
        (["estimate", "--system", "Academic", "--log", "a.csv", "--out", "b.png"], "overwrite"),
        (
            ["estimate", "--system", "Academic", "--log", "a.csv", "--P0-std", "-1", "2"],
            "deviations (-1.0",
        ),
        (["estimate", "--system", "Academic", "--log", "none_at_all.csv"], "no output at all"),
        (
            ["estimate", "--system", "Academic", "--log", "a.csv", "--process-noise", "-1"],
            "process_noise=-1.0; expected numbers of at least 0",
        ),
        (
            ["estimate", "--system", "Academic", "--log", "a.csv", "--process-noise", "1", "nan"],
            "process_noise=(1.0, nan); expected numbers of at least 0",
        ),
        (
            ["estimate", "--system", "Academic", "--log", "a.csv", "--process-noise", *"123"],
            "process_noise of Academic has shape (3,); expected 2 number(s)",
        ),
        (
            ["estimate", "--system", "Academic", "--log", "a.csv", "--process-noise", "x"],
            "parsing --process-noise",
        ),
        (["estimate", "--system", "Academic", "--log", "twice.csv"], "has column y1 twice"),
        (["evaluate", "--system", "failing_plug_in:X"], "'failing_plug_in:X': SyntaxError"),
        (["evaluate", "--system", "Academic", "--set", "assumed_noise=a"], "expected a number"),
        (["evaluate", "--system", "Academic", "--set", "assumed_noise=-1"], "assumed_noise=-1"),
        (
            ["evaluate", "--system", "Academic", "--set", "process_noise=1e-3"],
            "setting 'process_noise=1e-3'; expected name=value with a name of: assumed_noise, gate",
        ),
        (["dance"], "unknown command 'dance'; known are episodes, estimate, estimators, evaluate"),
        (["train", "pinn_obs", "--system", "Academic", "--budget", "-1"], "budget=-1.0; expected"),
        (["evaluate", "--systm", "Academic"], "unknown option --systm; did you mean '--system'?"),
        (
            ["evaluate", "--system", "Academic", "--episodes", "a"],
            "parsing --episodes: 'a'; expected a whole number",
        ),
        (["systems", "Academic", "b"], "Unrecognized options: b; see pinnobs systems --help"),
    ],
)
def test_mistakes_are_one_line_and_status_two(folder, capsys, arguments, message):
    (folder / "file").write_text("")
    (folder / "bad.csv").write_text("t,z\n0,1\n")
    (folder / "a.csv").write_text("t,y1\n0,1\n1,2\n")
    (folder / "twice.csv").write_text("t,y1,y1\n0,1,1\n")
    (folder / "none_at_all.csv").write_text("t,y1\n0,\n1,\n")
    (folder / "failing_plug_in.py").write_text("def\n")
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith("pinnobs: error: ")
    assert (folder / "a.csv").read_text() == "t,y1\n0,1\n1,2\n"


def test_the_parsers_mistakes_are_status_two_as_well(folder):
    assert run("evaluate") == 2
    assert run("evaluate", "--system", "Academic", "--episodes", "many") == 2
    assert run("train", "pinn_obs", "--system", "Academic", "--depth", "0") == 2
    assert run() == 2
    assert run("--help") == 0


def test_listings_name_everything(folder, capsys):
    assert run("systems") == 0
    assert run("estimators") == 0
    printed = capsys.readouterr().out
    words = printed.split()
    for name in (*map(env_id, SYSTEMS.classes().values()), *ESTIMATORS.classes()):
        assert name in words
    assert "phi1" in printed
    assert "offline" in words
    assert run("systems", "Satellite") == 0
    page = capsys.readouterr().out
    for words in ("## Action Space", "## Observation Space", "## Reward", "## Starting State"):
        assert words in page
    assert "| 2 | x3 | rad/s | ±3.5 | 2.2 |" in page
    assert "(I₂ − I₃)/I₁" in page


def test_leaderboard_prints_ranks_writes_and_resumes(folder, capsys):
    arguments = ["leaderboard", *QUICK, "--estimators", "open_loop", "ekf", "--out", "lb"]
    assert run(*arguments) == 0
    first = capsys.readouterr().out
    assert first.index(" ekf ") < first.index(" open_loop ")
    for what in ("lb/leaderboard.md", "lb/rows.jsonl", "lb/tensorboard"):
        assert what in first
    stored = (folder / "lb" / "rows.jsonl").read_text()
    assert len(stored.splitlines()) == 8
    assert run(*arguments) == 0
    assert (folder / "lb" / "rows.jsonl").read_text() == stored
    text = (folder / "lb" / "leaderboard.md").read_text()
    assert re.search(r"^\| 1 \| ekf \| .* \| online \| 4 \| ", text, re.MULTILINE)
    assert list((folder / "lb" / "tensorboard").rglob("events.*"))


def test_all_conditions_are_played_by_those_that_need_no_training(folder, capsys):
    played = Suite(
        ("ReverseDuffing", "InductionMotor"),
        tuple(map(Entry, ("ekf", "pinn_gain", "pinn_obs"))),
        ("all",),
        trained_episodes=1,
    )
    jobs = jobs_of(played, folder)
    played = {
        (system, estimator): [
            job.game.name.condition
            for job in jobs
            if (job.game.name.system, job.estimator) == (f"{system}-v0", estimator)
        ]
        for system in ("ReverseDuffing", "InductionMotor")
        for estimator in ("ekf", "pinn_gain", "pinn_obs")
    }
    assert set(played["InductionMotor", "ekf"]) == set(CONDITIONS)
    assert set(played["ReverseDuffing", "ekf"]) == set(CONDITIONS) - {"load_step"}
    assert played["ReverseDuffing", "pinn_gain"] == played["ReverseDuffing", "pinn_obs"]
    assert played["InductionMotor", "pinn_gain"] == ["nominal", "load_step"]


def test_conditions_are_ranked(folder, capsys):
    where = [*QUICK[:3], "50", *QUICK[4:], "--estimators", "open_loop", "ekf", "--out", "lb"]
    assert run("leaderboard", *where, "--condition", "nominal", "outliers+mismatch10") == 0
    printed = capsys.readouterr().out
    assert "Ranks" in printed
    assert "mismatch10+outliers" in printed  # the one name of both orders
    text = (folder / "lb" / "leaderboard.md").read_text()
    assert "| estimator | nominal | mismatch10+outliers | worst | knows |" in text
    assert "| ekf | 1 | 1 | 1 | model, prior, noise |\n| open_loop | 2 | 2 | 2 |" in text
    assert run("leaderboard", *where, "--condition", "all", "noise5") == 2


def test_a_damaged_rows_file_is_refused_before_anything_runs(folder, capsys):
    path = folder / "lb" / "rows.jsonl"
    path.parent.mkdir()
    path.write_text('{"schema": 3, "env\n{"schema": 2}\n')
    assert run("leaderboard", *QUICK, "--out", "lb") == 2
    assert "lb/rows.jsonl, line 1, is cut off" in capsys.readouterr().err
    path.write_text('{"schema": 2}\n')
    assert run("leaderboard", *QUICK, "--out", "lb") == 2
    assert "lb/rows.jsonl, line 1: rows of schema 2; expected 5" in capsys.readouterr().err
    assert path.read_text() == '{"schema": 2}\n'


def test_half_a_line_at_the_end_is_told_and_its_episode_is_run_again(folder, capsys):
    arguments = ["leaderboard", *QUICK, "--estimators", "ekf", "--out", "lb"]
    assert run(*arguments) == 0
    path = folder / "lb" / "rows.jsonl"
    whole = path.read_bytes()
    before = rows.read(path)
    path.write_bytes(whole[:-100])
    capsys.readouterr()
    assert run(*arguments) == 0
    assert "lb/rows.jsonl, line 4, is cut off" in capsys.readouterr().out
    assert path.read_bytes().startswith(whole[: whole.rindex(b"\n", 0, -1)])
    after = [r["nrmse"] for r in rows.read(path)]
    assert after == pytest.approx([r["nrmse"] for r in before], rel=1e-9)


def test_a_failed_job_is_told_left_out_and_tried_again_if_asked(folder, capsys):
    (folder / "failing_module.py").write_text(
        "from pathlib import Path\n"
        "from pinnobs_gym.estimators.ekf import EKF\n"
        "class Broken(EKF):\n"
        "    name = 'broken'\n"
        "    def correct(self, state, t, y, u):\n"
        "        if Path('mended').exists():\n"
        "            return super().correct(state, t, y, u)\n"
        "        raise RuntimeError('out of luck')\n"
    )
    estimators = ["--estimators", "failing_module:Broken", "ekf"]
    arguments = ["leaderboard", *QUICK, *estimators, "--out", "lb"]
    path = folder / "lb" / "rows.jsonl"

    def scored():
        return {row["estimator"] for row in rows.read(path)}

    assert run(*arguments) == 1
    printed = capsys.readouterr().out
    name = "broken on ReverseDuffing, nominal, 4 episodes"
    assert f"failed: {name}: RuntimeError: out of luck" in printed
    assert "Failed: broken, 4 episodes: RuntimeError: out of luck." in " ".join(printed.split())
    assert scored() == {"ekf"}
    (failure,) = rows.load(path).failures
    assert (failure["estimator"], failure["error"]) == ("broken", "RuntimeError: out of luck")
    (folder / "mended").touch()
    before = path.read_bytes()
    assert run(*arguments) == 1
    assert "1 job(s) failed before and were left out; --retry-failed" in capsys.readouterr().out
    assert path.read_bytes() == before
    assert run(*arguments, "--retry-failed") == 0
    assert "Failed" not in capsys.readouterr().out
    assert scored() == {"ekf", "broken"}
    assert rows.load(path).failures == []
    assert run(*arguments) == 0


def test_train_evaluate_and_refuse_another_system(folder, capsys):
    small = ["--depth", "1", "--width", "4", "--iterations", "20"]
    where = ["--system", "ReverseDuffing", "--out", "tr"]
    assert run("train", "pinn_obs", *where, *small) == 0
    printed = capsys.readouterr().out
    assert "after 20 iterations" in printed
    assert "pinn_obs_replay on own record" in printed
    assert re.search(
        "pinn_obs_replay is worth (some|no)thing on other records: of 10 from", printed
    )
    (trained,) = (path for path in Path("tr").glob("*.pt") if "checkpoint" not in path.name)
    assert len(list(Path("tr").glob("*.png"))) == 4
    before = trained.read_bytes()
    assert run("train", "pinn_obs", *where, *small) == 2
    assert "already exists; --resume continues it" in capsys.readouterr().err
    assert trained.read_bytes() == before
    assert run("train", "pinn_obs", *where, *small[:4], "--iterations", "30", "--resume") == 0
    assert "after 30 iterations" in capsys.readouterr().out
    scored = ["evaluate", "--estimator", "pinn_obs_replay", "--trained", trained]
    assert run(*scored, "--system", "ReverseDuffing", "--episodes", "2") == 0
    capsys.readouterr()
    assert run(*scored, "--system", "Academic", "--episodes", "2") == 2
    assert (
        "was trained with system='ReverseDuffing'; expected 'Academic'" in capsys.readouterr().err
    )
    trained.write_bytes(trained.read_bytes()[:100])
    assert run(*scored, "--system", "ReverseDuffing", "--episodes", "2") == 2
    assert "is damaged or no file of saved weights" in capsys.readouterr().err


def test_a_gain_is_trained_on_several_episodes_and_told_the_noise(folder, capsys):
    small = ["--episodes", "8", "--held-out", "2", "--iterations", "3", "--streams", "4"]
    where = ["--system", "Academic", "--out", "tr"]
    assert run("train", "pinn_gain", *where, *small) == 0
    assert "pinn_gain on own record" in capsys.readouterr().out
    (trained,) = (path for path in Path("tr").glob("*.pt") if "checkpoint" not in path.name)
    scored = ["evaluate", "--estimator", "pinn_gain", "--trained", trained, "--out", "ev"]
    for condition in ("nominal", "noise5"):
        more = ["--system", "Academic", "--episodes", "2", "--condition", condition]
        assert run(*scored, *more) == 0
    assert len({row["estimator_hash"] for row in rows.read(folder / "ev" / "rows.jsonl")}) == 2


def test_an_estimators_fault_is_one_line(folder, capsys):
    (folder / "faulty_module.py").write_text(
        "from pinnobs_gym.estimators.ekf import EKF\n"
        "class Faulty(EKF):\n"
        "    name = 'faulty'\n"
        "    def correct(self, state, t, y, u):\n"
        "        {}['missing']\n"
        "class Forgetful(EKF):\n"
        "    name = 'forgetful'\n"
        "    def correct(self, state, t, y, u):\n"
        "        pass\n"
    )
    where = ["evaluate", "--system", "Academic", "--episodes", "1"]
    assert run(*where, "--estimator", "faulty_module:Faulty") == 1
    assert "error: KeyError: 'missing' (PINNOBS_TRACEBACK=1 shows" in capsys.readouterr().err
    assert run(*where, "--estimator", "faulty_module:Forgetful") == 2
    assert "Forgetful.correct returned NoneType; expected a State" in capsys.readouterr().err


def test_a_recipe_can_be_set(folder, capsys):
    recipe = ["--set", "depth=1", "width=4", "iterations=5"]
    where = ["--system", "ReverseDuffing", "--estimator", "pinn_obs"]
    assert run("evaluate", *where, *recipe, "--episodes", "1", "--out", "ev") == 0
    (row,) = rows.read(folder / "ev" / "rows.jsonl")
    assert row["options"]["config"]["width"] == 4
    assert row["options"]["config"]["iterations"] == 5


def test_another_budget_trains_anew(folder, capsys):
    few = "{episodes = 8, held_out = 2, iterations = 3, streams = 4, width = 6}"
    (folder / "short.toml").write_text(f"estimators = [{{name = 'pinn_gain', settings = {few}}}]\n")
    arguments = ["leaderboard", "--suite", "short.toml", *QUICK, "--out", "lb"]
    for budget in ("1e6", "2e6"):
        assert run(*arguments, "--budget", budget) == 0
    budgets = [r["training"]["config"]["budget"] for r in rows.read(folder / "lb" / "rows.jsonl")]
    assert budgets == [1e6] * 4 + [2e6] * 4


def test_the_same_episode_is_not_run_a_hundred_times(folder, capsys):
    assert run("evaluate", "--system", "ReverseDuffing", "--setup", "paper", "--out", "ev") == 0
    assert "1 is run" in capsys.readouterr().out
    assert len(rows.read(folder / "ev" / "rows.jsonl")) == 1


def test_a_killed_run_loses_nothing_that_was_finished(folder):
    (folder / "endless_module.py").write_text(
        "import signal\n"
        "from pinnobs_gym.estimators.ekf import EKF\n"
        "class Endless(EKF):\n"
        "    name = 'endless'\n"
        "    def run(self, record):\n"
        "        signal.pause()\n"
    )
    command = [sys.executable, "-m", "pinnobs_gym.cli", "leaderboard", *QUICK]
    started = subprocess.Popen(
        [*command, "--estimators", "ekf", "endless_module:Endless"],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
    )
    path = folder / "runs" / "leaderboard" / "rows.jsonl"
    try:
        until(lambda: path.exists() and len(rows.read(path)) == 4)
    finally:
        os.killpg(started.pid, signal.SIGKILL)
        started.wait()
    assert len(rows.read(path)) == 4
    assert run("leaderboard", *QUICK, "--estimators", "ekf") == 0
    assert len(rows.read(path)) == 4


PENDULUM = Path(__file__).parents[3] / "shared" / "data" / "pendulum"

PENDULUM_MODULE = '''
from array_api_compat import array_namespace
from pinnobs_gym import Setup, System
from pinnobs_gym import stack


class Pendulum(System):
    """A pendulum swinging freely: angle from hanging at rest, angular velocity."""

    state_names = ("theta", "omega")
    output_names = ("y1",)
    scale = (1.0, 8.0)
    setups = {
        "benchmark": Setup(
            (-1.6, -3.0), (1.6, 3.0), duration=9.0, dt=0.01, noise_std=0.003
        )
    }

    def f(self, t, x, u):
        theta, omega = x[..., 0], x[..., 1]
        return stack(x, omega, -64.22 * array_namespace(x).sin(theta) - 0.0672 * omega)

    def h(self, t, x, u):
        return x[..., :1]
'''


@pytest.mark.skipif(not PENDULUM.exists(), reason="the recorded pendulum is not here")
@pytest.mark.parametrize(
    ("swing", "estimator", "largest"),
    [
        ("swing-1", ["ekf"], 0.01),
        ("swing-2", ["ekf"], 0.01),
        ("swing-1", ["pinn_obs", "--set", "iterations=1000"], 0.02),
    ],
)
def test_the_velocity_of_a_real_pendulum(folder, swing, estimator, largest):
    (folder / "pendulum_module.py").write_text(PENDULUM_MODULE)
    given = ["--system", "pendulum_module:Pendulum", "--log", PENDULUM / f"{swing}.csv"]
    assert run("estimate", *given, "--estimator", *estimator) == 0
    own = np.genfromtxt("estimates.csv", delimiter=",", names=True)
    reference = np.genfromtxt(PENDULUM / f"{swing}-velocity.csv", delimiter=",", names=True)
    later = reference["t"] >= 1
    error = np.interp(reference["t"], own["t"], own["omega"]) - reference["omega"]
    rms = np.sqrt((error[later] ** 2).mean())
    assert rms <= largest * abs(reference["omega"]).max()


@pytest.mark.skipif(not PENDULUM.exists(), reason="the recorded pendulum is not here")
def test_the_frequency_of_a_real_pendulum(folder):
    log = PENDULUM / "swing-2.csv"
    prior = ["--xhat0", 0, 0, 40, "--P0-std", 1, 4, 30, "--noise-std", 0.003]
    assert run("estimate", "--system", "HarmonicOscillator", "--log", log, *prior) == 0
    own = np.genfromtxt("estimates.csv", delimiter=",", names=True)
    crossings = own["t"][1:][np.diff(np.sign(own["x1"])) != 0]
    frequency = np.pi / np.diff(crossings[2:]).mean()  # half a period from one to the next
    assert np.sqrt(own["x3"][-1]) == pytest.approx(frequency, rel=0.03)
    assert own["x3"][-1] == pytest.approx(64.0, rel=0.06)


def test_ctrl_c_in_training_keeps_weights_and_checkpoint(folder, capsys):
    command = [
        sys.executable,
        "-m",
        "pinnobs_gym.cli",
        "train",
        "pinn_obs",
        "--preset",
        "paper",
        "--patience",
        str(10**9),
    ]
    command += ["--system", "Academic", "--out", "tr", "--depth", "1", "--width", "4"]
    endless = [*command, "--iterations", str(10**9)]
    with subprocess.Popen(
        endless,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=heed_ctrl_c,
    ) as started:
        try:
            # The curves begin after the first iteration.
            until(lambda: list((folder / "tr" / "tensorboard").rglob("events.*")))
            started.send_signal(signal.SIGINT)
            printed, _ = started.communicate(timeout=PATIENCE)
        finally:
            started.kill()
    assert started.returncode == 0
    assert "trained file: " in printed
    iterations = int(printed.partition(" after ")[2].partition(" ")[0])
    assert 0 < iterations < 10**9
    resume = ["--resume", "--iterations", str(iterations + 2)]
    assert run(*command[3:], *resume) == 0
    assert f"after {iterations + 2} iterations" in capsys.readouterr().out


def threads(given, commands):
    """How many torch and BLAS have in a process that runs such commands of ours."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    environment |= {} if given is None else {"OMP_NUM_THREADS": given}
    code = (
        "from pinnobs_gym.cli import main\n"
        f"for command in {commands!r}: main(command)\n"
        "import numpy, threadpoolctl, torch\n"
        "own = [p for p in threadpoolctl.threadpool_info() if p['user_api'] == 'blas']\n"
        "print(torch.get_num_threads(), max(p['num_threads'] for p in own))\n"
    )
    run = [sys.executable, "-c", code]
    done = subprocess.run(
        run, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=True
    )
    return done.stdout.splitlines()[-1]


def test_numerical_libraries_get_one_thread_unless_told_otherwise():
    """Told otherwise, they have as many as without our command: BLAS never more than cores."""
    command = ["systems"]
    assert threads(None, [command]) == "1 1"
    assert threads("2", [command]) == threads("2", [])
