"""A trainer and its estimator in a file of the user's, by command and from Python."""

import sys
from pathlib import Path

import pytest

import pinnobs_gym
from pinnobs_gym.cli import main
from pinnobs_gym.estimation.learned.trained import LearnedEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import TRAINERS, Registry
from pinnobs_gym.scoring import rows
from pinnobs_gym.training.trainer import Trainer

BOTH = '''
from dataclasses import dataclass, field

import numpy as np

from pinnobs_gym import Estimator, State
from pinnobs_gym.estimation.learned.trained import LearnedEstimator, Trained
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.simulation.model import model_step
from pinnobs_gym.training.settings import TrainingConfig
from pinnobs_gym.training.trainer import Trainer


@dataclass(frozen=True, eq=False, kw_only=True)
class TrainedGains(Trained):
    gain: np.ndarray

    def check_fits(self, path, system):
        check_same(path, {"nx": len(self.gain)}, {"nx": system.nx})


@dataclass(frozen=True)
class TwoGains(LearnedEstimator, Estimator):
    """The model, corrected by constant gains."""

    trained: TrainedGains = field(kw_only=True, repr=False)

    name = "two_gains"
    needs_training = NEEDS

    def reset(self, prior):
        return State(prior.mean)

    def update(self, state, t, y, u):
        xhat, dt = state.xhat, 0.0
        if state.t is not None:
            xhat, dt = model_step(self.system, state.t, t, xhat, state.u, u), t - state.t
        innovation = np.where(np.isnan(y), 0.0, y - self.system.h(t, xhat, u))
        return State(xhat + dt * self.trained.gain * innovation[:, :1], t, u)


@dataclass(frozen=True)
class Config(TrainingConfig):
    iterations: int = 2
    """Most iterations."""


class TwoGainsTrainer(Trainer[Config, TrainedGains]):
    """Counts."""

    name = "two_gains"
    presets = {"default": Config}

    def start(self):
        pass

    def step(self):
        self.iteration += 1

    def finished(self):
        return self.iteration >= self.config.iterations

    def progress(self):
        return 0.5

    def status(self):
        return ""

    def curves(self):
        return {}

    def state(self):
        return {}

    def load_state(self, state):
        pass

    def result(self):
        facts = self.facts(loss=0.1, seed=self.config.seed)
        return TrainedGains(**facts, gain=np.ones(self.system.nx))

    def figures(self, trained):
        return {}
'''
ON = ("--system", "ReverseDuffing")


@pytest.fixture(params=["two_gains", "two_gains:TwoGainsTrainer", "unknown_one"])
def needs(request):
    """The trainer that the estimator names."""
    return request.param


@pytest.fixture
def module(tmp_path, monkeypatch, needs):
    """The user's module, beside which commands are run; it is forgotten in the end."""
    (tmp_path / "two_gains.py").write_text(BOTH.replace("NEEDS", repr(needs)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with ESTIMATORS.isolated(), TRAINERS.isolated():
        yield "two_gains"
    sys.modules.pop("two_gains", None)


def run(*arguments):
    try:
        return main([str(a) for a in arguments])
    except SystemExit as end:
        return end.code


KNOWN = pytest.mark.parametrize("needs", ["two_gains", "two_gains:TwoGainsTrainer"], indirect=True)
UNKNOWN = pytest.mark.parametrize("needs", ["unknown_one"], indirect=True)


@KNOWN
def test_train_scores_the_estimator_that_stands_beside_the_trainer(module, capsys):
    assert run("train", f"{module}:TwoGainsTrainer", *ON, "--out", "tr") == 0
    printed = capsys.readouterr().out
    assert "two_gains on own record: RMSE" in printed
    files = [path.name for path in Path("tr").rglob("*")]
    assert not [name for name in files if ":" in name]
    assert any(name.endswith("-two_gains-episode1000000-seed0-two_gains.png") for name in files)
    (trained,) = (path for path in Path("tr").glob("*.pt") if "checkpoint" not in path.name)
    scored = ("evaluate", "--estimator", f"{module}:TwoGains", *ON, "--episodes", 2)
    assert run(*scored, "--trained", trained, "--out", "ev") == 0
    (first, _) = rows.load(Path("ev/rows.jsonl")).rows
    assert first["training"]["trainer"] == "two_gains"


@KNOWN
@pytest.mark.parametrize("jobs", [1, 2])
def test_the_leaderboard_trains_it_in_worker_processes(module, jobs):
    arguments = ("--systems", "ReverseDuffing", "--condition", "nominal", "--episodes", 2)
    arguments += ("--budget", 1, "--training-seeds", 0, 1, "--jobs", jobs)
    assert run("leaderboard", "--estimators", f"{module}:TwoGains", *arguments) == 0
    stored = rows.load(Path("runs/leaderboard/rows.jsonl")).rows
    assert {row["training_seed"] for row in stored} == {0, 1}
    files = [path.name for path in Path("runs/leaderboard").rglob("*")]
    assert not [name for name in files if ":" in name]


@KNOWN
def test_hints_name_what_the_command_takes(module, capsys):
    assert run("train", f"{module}:TwoGainsTrainer", *ON, "--iterations", "a") == 2
    assert f"see pinnobs train {module}:TwoGainsTrainer --help" in capsys.readouterr().err
    assert run("evaluate", "--estimator", f"{module}:TwoGains", *ON) == 2
    expected = f"has to be trained first: pinnobs train {module}:TwoGainsTrainer"
    assert expected in capsys.readouterr().err


@UNKNOWN
def test_an_unknown_trainer_is_laid_to_the_estimator(module, capsys):
    assert run("leaderboard", "--estimators", f"{module}:TwoGains", "--budget", 1) == 2
    assert (
        f"trainer of '{module}:TwoGains': unknown trainer 'unknown_one'; known are"
        in capsys.readouterr().err
    )


@KNOWN
def test_a_trainer_is_registered_like_any_other(module):
    import two_gains  # pyright: ignore

    assert pinnobs_gym.register(two_gains.TwoGainsTrainer) is two_gains.TwoGainsTrainer
    assert TRAINERS.resolve("two_gains") is two_gains.TwoGainsTrainer
    assert issubclass(two_gains.TwoGains, LearnedEstimator)


@KNOWN
def test_the_entry_points_of_trainers(module, tmp_path, monkeypatch):
    info = tmp_path / "own-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1\n")
    (info / "entry_points.txt").write_text(
        f"[pinnobs_gym.trainers]\ntwo_gains = {module}:TwoGainsTrainer\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    base = "pinnobs_gym.training.trainer:Trainer"
    fresh: Registry[Trainer] = Registry("trainer", base, "trainers", "name")
    assert fresh.resolve("two_gains").__module__ == module
