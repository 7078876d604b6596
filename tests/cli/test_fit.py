"""`pinnobs fit`, as a user meets it."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pinnobs_gym.cli import main

MODULE = '''
from dataclasses import dataclass

from array_api_compat import array_namespace
from pinnobs_gym import Setup, System, stack
from pinnobs_gym.simulation.system import independent


@dataclass(frozen=True)
class Swing(System):
    """A pendulum swinging freely: angle from hanging at rest, angular velocity."""

    omega2: float = 60.0
    damping: float = 0.1
    force: float = 1.0
    state_names = ("theta", "omega")
    output_names = ("angle",)
    input_names = ("push",)
    units = {"angle": "rad", "damping": "1/s"}
    scale = (1.0, 8.0)
    setups = {
        "benchmark": Setup(
            xhat0=(0.0, 0.0), P0=independent(1.0, 3.0), dt=0.01, noise_std=0.003
        )
    }

    def f(self, t, x, u):
        theta, omega = x[..., 0], x[..., 1]
        pull = -self.omega2 * array_namespace(x).sin(theta)
        return stack(x, omega, pull - self.damping * omega + u[..., 0])

    def h(self, t, x, u):
        return x[..., :1]

    def input(self, t):
        return 0.0 * self.force * t[..., None] + (self.force - 1.0)
'''
PENDULUM = Path(__file__).parents[3] / "shared" / "data" / "pendulum"


def run(*arguments):
    """The exit status of the command, also where the parser ends it."""
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    sys.modules.pop("fit_swing", None)
    (tmp_path / "fit_swing.py").write_text(MODULE)
    return tmp_path


def write_log(path, start, outputs="y1"):
    """A log of 150 samples of a swing with ω² = 64 and damping 0.07, by small Euler steps."""
    rng, theta, omega, lines = np.random.default_rng(0), *start, [f"t,{outputs}"]
    for k in range(150):
        lines.append(f"{0.01 * k:.2f},{theta + 0.003 * rng.standard_normal():.6f}")
        for _ in range(100):
            omega += 1e-4 * (-64 * np.sin(theta) - 0.07 * omega)
            theta += 1e-4 * omega
    path.write_text("\n".join(lines) + "\n")


GIVEN = ["--system", "fit_swing:Swing", "--log", "a.csv"]


def test_parameters_of_two_logs_with_a_picture_and_a_file(folder, capsys):
    write_log(folder / "a.csv", (1.0, 0.0))
    write_log(folder / "b.csv", (-0.5, 2.0))
    wanted = ["--parameters", "omega2=45", "damping=0.3,0,inf", "--out", "fit.json"]
    assert run("fit", *GIVEN, "b.csv", *wanted) == 0
    printed = capsys.readouterr().out
    assert "2 logs: 300 outputs, least squares over the trajectory" in printed
    assert "warning" not in printed
    found = json.loads((folder / "fit.json").read_text())["found"]
    assert f"in Python: Swing(omega2={found['omega2']['value']:.8g}, damping=" in printed
    for name, true in (("omega2", 64.0), ("damping", 0.07)):
        own = found[name]
        assert abs(own["value"] - true) < 4 * own["standard_error"]
    assert found["damping"]["unit"] == "1/s"
    with Image.open("fit.png") as image:
        assert image.width > image.height


def test_noise_as_options_to_paste(folder, capsys):
    write_log(folder / "a.csv", (1.0, 0.0))
    given = ["--process-noise", 0, 0.1, "--parameters", "omega2", "--noise"]
    assert run("fit", *GIVEN, *given) == 0
    printed = capsys.readouterr().out
    assert "as options: --noise-std 0.00" in printed
    assert "--process-noise 0 0" in printed
    assert "noise of angle" in printed


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "nothing to find; give --parameters, --noise or both (parameters of Swing: omega2"),
        (["--parameters", "k"], "unknown parameter 'k' of Swing; it has omega2, damping, force"),
        (["--parameters", "omega2=fast"], "parameter 'omega2=fast'; expected name"),
        (["--parameters", "force"], "parameter force of Swing acts on its input"),
        (["--noise", "--log", "a.csv"], "a.csv is given twice"),
        (["--noise", "--picture", "a.csv"], "would overwrite a log"),
        (["--noise", "--out", "a.csv/found.json"], "a.csv"),
        (["--noise", "--log", "other.csv"], "other.csv has no column y1"),
        (["--noise", "--log", "blank.csv"], "has no output at all"),
    ],
)
def test_a_mistake_is_told_in_one_line(folder, capsys, arguments, said):
    write_log(folder / "a.csv", (1.0, 0.0))
    write_log(folder / "other.csv", (1.0, 0.0), outputs="voltage")
    (folder / "blank.csv").write_text("t,y1\n0,\n0.01,\n")
    assert run("fit", *GIVEN, *arguments) == 2
    told = capsys.readouterr().err
    assert said in told
    assert told.count("\n") == 1
    assert not (folder / "fit.png").exists()


@pytest.mark.skipif(not PENDULUM.exists(), reason="the recorded pendulum is not here")
@pytest.mark.parametrize("start", [45, 64, 83])
def test_the_frequency_of_a_real_pendulum(folder, start):
    logs = [PENDULUM / f"swing-{i}.csv" for i in (1, 2)]
    given = ["--parameters", f"omega2={start}", "damping", "--out", "fit.json"]
    assert run("fit", "--system", "fit_swing:Swing", "--log", *logs, *given) == 0
    found = json.loads((folder / "fit.json").read_text())
    assert found["found"]["omega2"]["value"] == pytest.approx(64.22, rel=0.005)
    assert any("correlated" in line for line in found["warnings"])


def test_what_is_to_be_pasted_is_of_the_plant_without_further_states(folder, capsys):
    """With a bias as a further state, class and process noise are still those of the model."""
    write_log(folder / "a.csv", (1.0, 0.0))
    given = ["--parameters", "omega2", "--noise", "--also", "bias_angle=0,0.01"]
    assert run("fit", *GIVEN, *given, "--process-noise", 0, 0.1) == 0
    printed = capsys.readouterr().out
    assert "in Python: Swing(omega2=" in printed
    (line,) = [line for line in printed.splitlines() if line.startswith("as options: ")]
    assert len(line.partition("--process-noise ")[2].split()) in (1, 2)
    assert "Setup.process_noise" not in printed
