import signal
import subprocess
import sys
from dataclasses import dataclass, fields
from typing import ClassVar

import numpy as np
import pytest
from linear import Linear
from waiting import PATIENCE, heed_ctrl_c, until

from pinnobs_gym.cli import main
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimation.estimator import Estimator, Range, State
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.scoring import rows, tuning
from pinnobs_gym.scoring.evaluation import evaluate
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.tuning import TUNING_SEED, Search


@dataclass(frozen=True)
class Stubborn(Estimator):
    """Always says the same, which is best near the middle of the initial set."""

    guess: float = 0.9
    times: int = 1

    tunable: ClassVar = {"guess": Range(-1.0, 1.0), "times": Range(1, 3)}

    def __post_init__(self):
        if self.times == 2:
            raise ValueError("times=2; expected an odd number")

    def reset(self, prior):
        return State(0 * prior.mean + self.guess)

    def update(self, state, t, y, u):
        return State(state.xhat, t=t)


def search(path, **changes):
    chosen = {"estimator": Stubborn, "condition": "nominal", "episodes": 8, **changes}
    game = Game.of(chosen.get("system", Linear), condition=chosen["condition"])
    return Search(chosen["estimator"], game, chosen["episodes"], path / "trials")


@pytest.mark.parametrize(
    ("name", "setting"),
    [(name, setting) for name, cls in ESTIMATORS.classes().items() for setting in cls.tunable],
)
def test_what_is_searched_is_a_setting_whose_default_is_in_its_range(name, setting):
    cls = ESTIMATORS.resolve(name)
    (default,) = (f.default for f in fields(cls) if f.name == setting)
    bounds = cls.tunable[setting]
    assert bounds.low < bounds.high
    assert default is None or bounds.low <= default <= bounds.high


def test_it_finds_the_best_and_passes_over_what_is_not_taken(tmp_path):
    told = []
    one = search(tmp_path)
    one.run(30, told.append)
    assert len(told) == one.done() == 30
    assert None in told  # settings that the estimator refused
    best = one.best()
    assert abs(best.settings["guess"]) < 0.25  # the set is symmetric about zero
    assert best.settings["times"] in (1, 3)
    assert best.error == min(tried.error for tried in told if tried is not None)
    assert best.error == one.error(best.settings)


def test_its_process_noise_is_that_of_the_plant(tmp_path):
    one = search(tmp_path, estimator=EKF, condition="process_noise1e-2", episodes=32)
    one.run(15, lambda tried: None)
    # Over the duration of 20 samples, the variance of the plant's noise is 20 times as large.
    assert 1 / 5 < one.best().settings["assumed_noise"] / (1e-2 * np.sqrt(20)) < 5


def test_it_goes_on_with_what_was_tried(tmp_path):
    first, told = search(tmp_path), []

    def stop(tried):
        told.append(tried)
        if len(told) == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.run(10, stop)
    assert first.done() == 4
    again = search(tmp_path)
    again.run(7, told.append)
    assert len(told) == 7
    settings = [tuple(tried.settings.values()) for tried in told if tried is not None]
    assert len(set(settings)) == len(settings)  # what was tried is not tried again
    again.run(7, told.append)
    assert len(told) == 7


@pytest.mark.parametrize(("name", "base"), [("estimator", Stubborn), ("system", Linear)])
def test_trials_of_code_that_cannot_be_read_are_not_reused(tmp_path, name, base):
    scope = {"__name__": "nowhere", "Base": base}
    exec("class Hidden(Base): pass", scope)
    first, told = search(tmp_path, **{name: scope["Hidden"]}), []
    first.run(4, told.append)
    first.run(6, told.append)  # the same search goes on
    assert len(told) == first.done() == 6
    assert first.best().error == min(tried.error for tried in told if tried is not None)
    again = search(tmp_path, **{name: scope["Hidden"]})
    assert again.done() == 0
    assert again.best() is None
    again.run(2, told.append)
    assert (again.done(), first.done(), len(told)) == (2, 6, 8)
    again.forget()
    assert (again.done(), first.done()) == (0, 6)


def test_episodes_are_never_the_leaderboards(tmp_path, monkeypatch):
    seen = []

    def noted(game, estimator, seeds):
        seen.extend(seeds)
        played = play(game, estimator, seeds)
        played.estimates.xhat[0] = played.truth[0] + 0.5  # of the scale, and diverged
        played.estimates.xhat[1] = played.truth[1] + 0.1
        return played

    monkeypatch.setattr(tuning, "play", noted)
    error = search(tmp_path, episodes=2).error({})
    assert seen == [TUNING_SEED, TUNING_SEED + 1]
    assert error == pytest.approx((10 * 0.1) ** 0.5)  # one that diverged counts as 10


def test_the_error_is_the_geometric_mean_over_episodes_and_both_ranked_windows(tmp_path):
    one = search(tmp_path, estimator=EKF, episodes=3)
    scored = evaluate(EKF, env_id(Linear), episodes=3, seed=TUNING_SEED)
    errors = [row[f"nrmse_{window}"] for row in scored for window in ("steady", "transient")]
    assert one.error({}) == pytest.approx(np.prod(errors) ** (1 / 6))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["pinn_gain"], "'pinn_gain' is trained; its settings are not searched"),
        (["open_loop"], "'open_loop' declares no settings to search"),
        (["ekf", "--trials", "0"], "trials=0; expected at least 1"),
        (["ekf", "--episodes", "0"], "episodes=0; expected at least 1"),
        (["kf"], "unknown estimator 'kf'"),
        (["ekf", "kf"], "unknown estimator 'kf'"),
        ([], "no estimator is given; expected NAME ..."),
        (["ekf", "--store", "--condition", "gap"], "condition 'gap' with --store; settings are st"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tune", *arguments, "--system", "Academic"]) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def test_without_optuna_it_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "optuna", None)
    assert main(["tune", "ekf", "--system", "Academic"]) == 2
    assert 'pip install "pinnobs-gym[tune]"' in capsys.readouterr().err


def test_a_file_that_holds_no_trials_is_told(tmp_path):
    (tmp_path / "trials").write_text("no journal\n")
    with pytest.raises(ValueError, match=r"cannot read trials from .*trials"):
        search(tmp_path).done()


def test_the_command_prints_settings_that_evaluate_takes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    where = ["--system", "ReverseDuffing", "--condition", "process_noise1e-2"]
    assert main(["tune", "ekf", *where, "--trials", "6", "--episodes", "4"]) == 0
    printed = capsys.readouterr().out
    (line,) = (line for line in printed.splitlines() if line.startswith("--set "))
    assert main(["evaluate", *where, "--episodes", "1", "--out", "ev", *line.split()]) == 0
    (row,) = rows.read(tmp_path / "ev" / "rows.jsonl")
    assert line == f"--set assumed_noise={row['options']['assumed_noise']}"


def test_ctrl_c_keeps_what_was_tried_and_the_next_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["tune", "ekf", "--system", "Academic", "--condition", "dt5", "--episodes", "4"]
    command += ["--out", "tune"]
    path = tmp_path / "tune" / "Academic-v0-benchmark-dt5-ekf.journal"
    one = Search(EKF, Game.of("Academic", condition="dt5"), 4, path)
    with subprocess.Popen(
        [sys.executable, "-m", "pinnobs_gym.cli", *command, "--trials", str(10**9)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=heed_ctrl_c,
    ) as process:
        try:
            until(lambda: process.poll() is not None or (path.exists() and one.done() >= 5))
            process.send_signal(signal.SIGINT)
            printed, told = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    assert process.returncode == 130, told
    assert "Traceback" not in printed + told
    done, best = one.done(), one.best()
    assert done >= 5
    if best.error < one.error({}):
        assert f"best:    geometric mean NRMSE {best.error:.4g}" in printed
        (line,) = (line for line in printed.splitlines() if line.startswith("--set "))
        for name, value in best.settings.items():
            assert f"{name}={value}" in line
    else:
        assert "nothing better than the default was found" in printed
    assert "trials: tune/Academic-v0-benchmark-dt5-ekf.journal" in printed
    assert main([*command, "--trials", f"{done + 2}"]) == 0
    assert one.done() == done + 2  # two more, and what was there is still there
    assert one.best().error <= best.error
