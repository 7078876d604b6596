"""`pinnobs estimate` on logs as users have them: other columns, several files, unknown constants,
trained estimators."""

import csv
import shlex
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from export_figures.built import COMPILER, replay
from exported import needs_c
from scipy.linalg import expm

from pinnobs_gym.cli import main
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.batch_least_squares import BatchLeastSquares
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.leaderboard import published
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.trained import load_published
from pinnobs_gym.logs.reading import read_log
from pinnobs_gym.simulation.augmented import augmented, with_constants
from pinnobs_gym.simulation.augmented_system import Unknown
from pinnobs_gym.simulation.record import Prior

MODULE = '''
from dataclasses import dataclass

from pinnobs_gym import Setup, System
from pinnobs_gym.simulation.system import independent, stack


@dataclass(frozen=True)
class Swing(System):
    """A mass on a spring, pushed by a known force."""

    k: float = 4.0
    d: float = 0.0

    state_names = ("p", "v")
    output_names = ("place",)
    input_names = ("force",)
    units = {"k": "1/s²"}
    scale = (1.0, 2.0)
    setups = {"benchmark": Setup(dt=0.1, noise_std=0.05, xhat0=(0.0, 0.0), P0=independent(1, 2))}

    def f(self, t, x, u):
        push = u[..., 0] - self.k * x[..., 0] - self.d * x[..., 1]
        return stack(x, x[..., 1], push)

    def h(self, t, x, u):
        return x[..., :1]
'''
SHIPPED = Path(published.__file__).parent
SYSTEM = ["--system", "swing_of_this_test:Swing"]


def run(*arguments):
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "swing_of_this_test.py").write_text(MODULE)
    return tmp_path


@pytest.fixture
def shipped(monkeypatch):
    """The trained estimators that ship with the package."""
    monkeypatch.setattr("pinnobs_gym.leaderboard.published.manifest.FOLDER", SHIPPED)
    if Manifest.read(SHIPPED) is None:
        pytest.skip("this copy has no published results")


def simulated(num_samples=300, k=4.4, bias=0.0, seed=1):
    """Times, outputs and held forces (num_samples,) of the spring, by the matrix exponential."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.choice([-1.0, 1.0], num_samples // 10 + 1), 10)[:num_samples]
    step = expm(0.1 * np.array([[0, 1, 0], [-k, 0, 1], [0, 0, 0]]))
    x, y = np.array([0.5, 1.0]), []
    for force in u:
        y.append(x[0] + bias + 0.05 * rng.standard_normal())
        x = (step @ [*x, force])[:2]
    return 0.1 * np.arange(num_samples), np.array(y), u


def write(path, columns):
    path.parent.mkdir(exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True))


def estimates(path="estimates.csv"):
    return np.genfromtxt(path, delimiter=",", names=True)


def test_columns_units_and_dates_give_the_same_estimates(folder, capsys):
    t, y, u = simulated(50)
    write(Path("plain.csv"), {"t": t, "y1": y, "u1": u})
    assert run("estimate", *SYSTEM, "--log", "plain.csv", "--out", "a.csv") == 0
    assert "not used" not in capsys.readouterr().out
    dates = [f"2026-03-01T23:59:{57 + k // 10:02}.{k % 10}Z" for k in range(30)]
    dates += [f"2026-03-02T00:00:{k // 10:02}.{k % 10}Z" for k in range(20)]
    write(
        Path("own.csv"),
        {"date (UTC)": dates, "place": y, "mN": 1000 * u, "note": np.zeros(50)},
    )
    given = ["--columns", "t={date (UTC)}", "force=mN*1e-3"]
    assert run("estimate", *SYSTEM, "--log", "own.csv", *given, "--out", "b.csv") == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[:2] == [
        "log own.csv: t = 0 is 2026-03-01T23:59:57+00:00",
        "log own.csv: columns that are not used: note",
    ]
    first, second = estimates("a.csv"), estimates("b.csv")
    for name in ("t", "p", "v", "p_std", "v_std"):
        np.testing.assert_allclose(second[name], first[name], rtol=1e-9, atol=1e-9)


def test_several_logs_are_estimated_each_by_itself(folder, capsys):
    for name, seed in (("a", 1), ("b.2", 2)):
        t, y, u = simulated(40, seed=seed)
        write(Path("logs", f"{name}.csv"), {"t": t, "place": y, "force": u})
    both = ["--log", "logs/a.csv", "logs/b.2.csv"]
    assert run("estimate", *SYSTEM, *both, "--out", "out/x.csv") == 0
    names = sorted(path.name for path in Path("out").iterdir())
    assert names == ["x-a.csv", "x-a.png", "x-b.2.csv", "x-b.2.png"]
    printed = capsys.readouterr().out
    assert "a.csv: 40 samples; at t = 3.9 s: p = " in printed
    assert "estimates: out/x-b.2.csv; picture: out/x-b.2.png" in printed
    for name in ("a", "b.2"):
        assert run("estimate", *SYSTEM, "--log", f"logs/{name}.csv", "--out", "one.csv") == 0
        assert Path("one.csv").read_bytes() == Path("out", f"x-{name}.csv").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--log", "a.csv", "f/a.csv"], "logs a.csv and f/a.csv would both be written to estimate"),
        (["--log", "a.csv", "a.csv"], "logs a.csv and a.csv would both be written to"),
        (["--log", "a.csv", "f/A.csv"], "logs a.csv and f/A.csv would both be written to"),
        (["--log", "a.csv", "x-a.csv", "--out", "x.csv"], "overwrite the log x-a.csv"),
        (["--log", "a.csv", "none.csv"], "cannot read log none.csv"),
        (["--log", "a.csv", "--columns", "t=9**9**9"], "line 2: t=9**9**9 is inf; expected a fin"),
        (["--log", "a.csv", "--columns", "place=os.system"], "'.' is not part of a formula"),
        (["--log", "ms.csv"], 'give --columns "t=t*1e-3", or t=t if it is right'),
        (["--log", "jump.csv"], "log jump.csv, line 3: from t=0 s to t=1700000000 s, Swing would"),
        (["--log", "a.csv", "--also", "kk"], "also='kk'; expected NAME or NAME=mean,std with a n"),
        (
            ["--log", "a.csv", "--also", "kk"],
            "bias_place, disturbance_p, disturbance_v, rate_p, rate_v;",
        ),
        (["--log", "a.csv", "--also", "k", "k=1,2"], "also='k=1,2': k is given twice"),
        (["--log", "a.csv", "--also", "d"], "also='d'; expected d=mean,std, as it is 0.0 in the"),
        (["--log", "a.csv", "--also", "bias_place"], "expected bias_place=mean,std, as the model"),
        (["--log", "a.csv", "--also", "k=1"], "also='k=1'; expected NAME=mean,std: two numbers,"),
        (["--log", "a.csv", "--also", "k=1,0"], "the second above 0"),
        (["--log", "a.csv", "--also", "k=nan,1"], "two numbers"),
        (
            ["--log", "a.csv", "--also", "k", "--xhat0", "0", "0", "4"],
            "--xhat0 has 3 number(s); expected 2, one for each of p, v",
        ),
        (["--log", "a.csv", "--P0-std", "1"], "--P0-std has 1 number(s); expected 2, one for each"),
        (["--log", "a.csv", "--trained", "x.pt"], "estimator 'ekf' is not one that is trained fir"),
        (["--log", "a.csv", "--trained", "x.pt"], "name that of the file, --estimator NAME"),
        (["--log", "a.csv", "--estimator", "pinn_gain"], "give its file, --trained FILE"),
        (
            ["--log", "a.csv", "--estimator", "pinn_gain", "--trained", "none.pt"],
            "none.pt",
        ),
        (
            ["--log", "a.csv", "--estimator", "pinn_gain", "--trained", "n.pt", "--set", "gate=1"],
            "--trained and --set; expected one of them",
        ),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(folder, capsys, arguments, message):
    for path in ("a.csv", "f/a.csv", "f/A.csv", "x-a.csv"):
        write(Path(path), {"t": [0.0, 0.1, 0.2], "place": [1, 1, 1], "force": [0, 0, 0]})
    write(Path("ms.csv"), {"t": [0, 100, 200], "place": [1, 1, 1], "force": [0, 0, 0]})
    write(Path("jump.csv"), {"t": [0, 1.7e9], "place": [1, 1], "force": [0, 0]})
    before = {path: path.read_bytes() for path in folder.rglob("*.csv")}
    assert run("estimate", *SYSTEM, *arguments) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1
    assert len(printed) < 450
    assert {path: path.read_bytes() for path in folder.rglob("*.csv")} == before
    assert not list(folder.rglob("*.png"))


def test_unknown_constants_are_found_with_their_deviations(folder, capsys):
    t, y, u = simulated(k=4.4, bias=0.2)
    write(Path("log.csv"), {"t": t, "place": y, "force": u})
    also = ["--also", "k", "bias_place=0,0.5", "disturbance_v=0,0.3"]
    assert run("estimate", *SYSTEM, "--log", "log.csv", *also, "--xhat0", 0.4, 0.8) == 0
    printed = capsys.readouterr().out
    last = estimates()[-1]
    assert abs(last["k"] - 4.4) < 4 * last["k_std"] < 0.4
    # A constant push moves the place like a bias by push/k: together they are 0.2.
    assert abs(last["bias_place"] + last["disturbance_v"] / 4.4 - 0.2) < 0.05
    found = [line for line in printed.splitlines() if line.startswith("found: ")]
    assert len(found) == 3
    assert found[0].startswith(f"found: k = {last['k']:.6g} ± {last['k_std']:.2g} 1/s² (before the")
    assert found[0].endswith("4 ± 0.4)")


def test_also_is_augmented_with_the_users_own_noise_and_prior(folder):
    told = {
        "noise_std": (0.2,),
        "process_noise": (0.1, 0.3),
        "xhat0": (0.1, 0.2),
        "P0_std": (3.0, 4.0),
    }
    system, setup = ModelOptions(**told, also=("d=0.1,0.05", "k")).told("swing_of_this_test:Swing")
    plant, own = ModelOptions(**told).told("swing_of_this_test:Swing")
    by_hand = augmented(plant, {"d": Unknown(0.1, 0.05), "k": Unknown(4.0, 0.4)})
    assert type(system) is type(by_hand)
    assert system.state_names == ("p", "v", "d", "k")
    prior = Prior.of(system, setup, 1)
    np.testing.assert_allclose(prior.mean, [[0.1, 0.2, 0.1, 4.0]])
    np.testing.assert_allclose(prior.cov, [np.diag([3.0, 4.0, 0.05, 0.4]) ** 2])
    noise, plain = (
        system.noise(setup.noise_std, setup.process_noise),
        plant.noise(own.noise_std, own.process_noise),
    )
    L = noise.L(0.0)[..., 0]
    np.testing.assert_allclose(L @ L.T, np.diag([0.01, 0.09, 0.0, 0.0]))
    np.testing.assert_array_equal(noise.R(0.0), plain.R(0.0))


def test_a_constant_of_a_setup_with_parameters_has_the_mean_that_is_given(folder):
    plant, setup = ModelOptions().told("swing_of_this_test:Swing")
    system = augmented(plant, {"k": Unknown(9.0, 1.0)})
    mean = with_constants(system, replace(setup, parameters={"k": 5.0})).xhat0
    assert mean == (0.0, 0.0, 9.0)


def test_least_squares_finds_the_same_constant(folder):
    """Without process noise the last estimate of an EKF is near the least squares' one."""
    t, y, u = simulated(k=4.4)
    write(Path("log.csv"), {"t": t, "place": y, "force": u})
    system, setup = ModelOptions(also=("k",)).told("swing_of_this_test:Swing")
    log = read_log("log.csv", system, Prior.of(system, setup, 1))
    found = [
        kind.for_setup(log.system, setup).run(log.record).xhat[0, -1, 2]
        for kind in (EKF, BatchLeastSquares)
    ]
    assert found == pytest.approx([4.4, 4.4], abs=0.06)


@pytest.mark.parametrize(
    "name",
    ["kkl_supervised", "kkl_pinn", "kkl_autoencoder", "pinn_gain", "pinn_obs_replay", "sb3"],
)
def test_a_trained_estimator_on_a_log_is_as_on_the_record(folder, shipped, name):
    game = Game.of("ReverseDuffing")
    record = game.record([0])
    estimator = load_published(name, game)
    estimator.save("trained.pt")  # pyright: ignore[reportAttributeAccessIssue]
    write(Path("log.csv"), {"t": record.t, "y1": record.y[0, :, 0]})
    given = ["--system", "ReverseDuffing", "--log", "log.csv", "--estimator", name]
    assert run("estimate", *given, "--trained", "trained.pt") == 0
    own = estimator.run(record).xhat[0]
    found = estimates()
    for i, state in enumerate(("x1", "x2")):
        np.testing.assert_allclose(found[state], own[:, i], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "system", "step", "message"),
    [
        ("pinn_gain", "Academic", 0.02, "was trained with system='ReverseDuffing'; expected 'Acad"),
        (
            "pinn_obs_replay",
            "ReverseDuffing",
            0.05,
            "was trained on t=0 s to 19.98 s; the record ha",
        ),
        ("kkl_pinn", "ReverseDuffing", 0.02, "is not a saved TrainedKKL"),
        ("sb3", "ReverseDuffing", 0.05, "was trained on samples every 0.02 s; the record has a st"),
    ],
)
def test_a_trained_file_that_does_not_fit_is_one_line(
    folder, shipped, capsys, name, system, step, message
):
    saved = "pinn_gain" if name == "kkl_pinn" else name
    estimator = load_published(saved, Game.of("ReverseDuffing"))
    estimator.save("trained.pt")  # pyright: ignore[reportAttributeAccessIssue]
    t = step * np.arange(1001)
    write(Path("log.csv"), {"t": t, "y1": np.cos(t)})
    given = ["--system", system, "--log", "log.csv", "--estimator", name]
    assert run("estimate", *given, "--trained", "trained.pt") == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def following(capsys):
    """The arguments of the command that was named as the next one."""
    line = capsys.readouterr().out.splitlines()[-1]
    assert line.startswith("next: pinnobs ")
    return shlex.split(line)[2:]


@needs_c
def test_the_next_command_exports_the_filter_that_was_run(folder, capsys):
    """As C, which gives the estimates that were written."""
    t, y, u = simulated(60)
    write(Path("log.csv"), {"t": t, "place": y, "force": u})
    told = ["--noise-std", 0.07, "--xhat0", 0.1, 0.2, "--P0-std", 0.5, 2, "--also", "k=4.2,0.5"]
    given = [*told, "--set", "assumed_noise=0.02", "gate=0.999"]
    assert run("estimate", *SYSTEM, "--log", "log.csv", *given) == 0
    words = following(capsys)
    assert words[0] == "export"
    assert run(*words) == 0
    build = [COMPILER, "-O1", "ekf.c", "ekf_replay.c", "-lm", "-o", "replay"]
    subprocess.run(build, check=True)
    found, said = replay(Path("replay").resolve(), Path("log.csv").read_text())
    assert not said
    expected = np.loadtxt("estimates.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(found, expected[:, : found.shape[1]], rtol=1e-6, atol=1e-9)


def test_the_next_command_fits_with_what_was_told(folder, capsys):
    """Where the log speaks against the noise; and the one after it estimates with what it found."""
    t, y, u = simulated(300, k=4.0)
    write(Path("log.csv"), {"ms": 1000 * t, "place": y, "force": u})
    given = ["--columns", "t=ms*1e-3", "--noise-std", 0.01, "--process-noise", 0]
    assert run("estimate", *SYSTEM, "--log", "log.csv", *given) == 0
    words = following(capsys)
    assert words[0] == "fit"
    assert run(*words) == 0
    words = following(capsys)
    assert words[:2] == ["estimate", "--system"]
    noise = float(words[words.index("--noise-std") + 1])
    assert 0.045 < noise < 0.055  # that of the log, 0.05
    assert run(*words) == 0
    assert "warning" not in capsys.readouterr().out
