"""The paper's tables by command: what the paper prints, and running, stopping and going on."""

import json
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import gymnasium as gym
import numpy as np
import pytest
import readme
import reproduce_paper
from reproduction import comparison, report, running
from reproduction.tables import TABLES, Case, Printed, Table, recipe

import pinnobs_gym
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.training.log import Log
from trainers.pinn_obs import paper

SMALL = {"depth": 1, "width": 4, "iterations": 60, "points": 40, "checkpoint_every": 10}
PRINTED = Printed(rmse=0.5, mae=0.25)


@pytest.fixture
def short(monkeypatch):
    """Tables of one quick case each, of a system whose record is short."""

    @pinnobs_gym.register
    @dataclass(frozen=True)
    class ShortDuffing(ReverseDuffing):
        """ReverseDuffing over two seconds."""

        setups: ClassVar = {
            **ReverseDuffing.setups,
            "paper": replace(ReverseDuffing.setups["paper"], duration=2.0, dt=0.02),
        }

    case = Case("one", PRINTED, {**SMALL, "log_every": 5}, system="ShortDuffing")
    other = replace(case, name="other", settings={**case.settings, "width": 5})
    for name in TABLES:
        table = Table("A table", "nowhere", (case, other), ("A note.",))
        monkeypatch.setitem(reproduce_paper.TABLES, name, table)
    return case


def command(*arguments, out):
    return reproduce_paper.main([*arguments, "--jobs", "1", "--out", str(out)])


def rows_in(folder):
    return report.read(folder / "results.jsonl")


def stop_at(monkeypatch, iteration):
    """Ctrl-C at an iteration that is logged."""
    log = Log.scalar
    heeded = signal.signal(signal.SIGINT, signal.default_int_handler)  # it may be ignored here

    def scalar(self, tag, value, step):
        if step == iteration and tag == "loss/best":
            signal.raise_signal(signal.SIGINT)
            signal.signal(signal.SIGINT, heeded)
        log(self, tag, value, step)

    monkeypatch.setattr(Log, "scalar", scalar)


# What the paper prints


def test_every_row_of_the_paper_is_there():
    assert {name: len(table.cases) for name, table in TABLES.items()} == {
        "depth": 16,
        "activation": 4,
        "weights": 7,
        "examples": 6,
    }
    for table in TABLES.values():
        names = [case.name for case in table.cases]
        assert len(set(names)) == len(names)


def test_the_printed_figures_agree_with_the_text():
    cases = {name: {case.name: case for case in t.cases} for name, t in TABLES.items()}
    best = Printed(0.0562, 0.01428, 9.56e-4, 101431, 2684.33, 1.2374)
    assert cases["depth"]["9x20"].printed == best
    assert min(case.printed.loss for case in cases["depth"].values()) == best.loss
    assert min(case.printed.rmse for case in cases["activation"].values()) == 0.0535
    assert min(case.printed.loss for case in cases["weights"].values()) == 6.28e-4
    baseline = cases["weights"]["1"].printed
    assert (baseline.rmse, baseline.iterations) == (best.rmse, best.iterations)


def test_only_the_noted_row_has_an_mae_over_its_rmse():
    rows = [case for table in TABLES.values() for case in table.cases if case.printed.mae]
    assert [case.name for case in rows if case.printed.mae > case.printed.rmse] == ["9x15"]
    assert "9x15" in TABLES["depth"].notes[0]


def test_settings_are_those_of_the_names():
    for case in TABLES["depth"].cases:
        config = of("paper", case)
        assert case.name == f"{config.depth}x{config.width}"
    for case in TABLES["activation"].cases:
        assert of("paper", case) == replace(paper(), activation=case.name)
    weights = [(c.w0, c.w_ode, c.w_y) for c in (of("guided", k) for k in weighted())]
    assert weights[0] == (1, 1, 1)
    assert weights[5] == (2, 1, 0.5)


def of(preset, case):
    return recipe(preset, case, seed=0, budget=None)


def weighted():
    return TABLES["weights"].cases


def test_a_case_of_two_tables_is_trained_once():
    (wide,) = (case for case in TABLES["depth"].cases if case.name == "9x20")
    (tanh,) = (case for case in TABLES["activation"].cases if case.name == "tanh")
    jobs = [running.PaperJob(case, "guided", of("guided", case), Path()) for case in (wide, tanh)]
    assert jobs[0].key == jobs[1].key
    assert jobs[0].folder == jobs[1].folder


# Running


def test_a_run_leaves_its_row_table_and_pictures(short, tmp_path, capsys):
    assert command("examples", "--only", "one", out=tmp_path) == 0
    (row,) = rows_in(tmp_path)
    assert 0 < row["mae"] < row["rmse"] < 5
    assert row["best_iteration"] <= row["iterations"] <= 60
    assert row["loss"] > 0
    assert row["inference_ms"] > 0
    (folder,) = tmp_path.glob("ShortDuffing-guided-1x4-tanh-*/budget-120")
    for picture in ("states", "replay", "gain", "loss"):
        assert (folder / f"{picture}.png").stat().st_size > 1000
    assert not (folder / "checkpoint.pt").exists()  # it came to its end
    table = (tmp_path / "examples.md").read_text()
    assert "| one | the paper | 0.5000 | 0.25000 |" in table
    assert f"| one | fast, guided, to the end | {row['rmse']:.4f} |" in table
    assert "| other | the paper |" in table
    assert "100 samples over 2 s: ShortDuffing x₀ = [2, -1], x̂₀ = [1, 1]." in table
    assert "A note." in table
    assert row["processor"] in table
    assert "RMSE" in capsys.readouterr().out


def test_a_second_run_does_only_what_is_missing(short, tmp_path, monkeypatch):
    trained = []
    train = running.train
    monkeypatch.setattr(running, "train", lambda t, **k: trained.append(t.config) or train(t, **k))
    assert command("depth", "--only", "one", out=tmp_path) == 0
    assert command("depth", out=tmp_path) == 0
    assert [config.width for config in trained] == [4, 5]
    assert command("weights", out=tmp_path) == 0  # the same cases
    assert command("depth", "--budget", "none", out=tmp_path) == 0  # they had come to their end
    assert len(trained) == len(rows_in(tmp_path)) == 2
    assert command("depth", "--only", "one", "--seed", "1", out=tmp_path) == 0
    assert len(trained) == 3


def test_a_stopped_run_goes_on_to_the_same_result(short, tmp_path, monkeypatch, capsys):
    assert command("depth", "--only", "one", out=tmp_path / "whole") == 0
    with monkeypatch.context() as patch:
        stop_at(patch, 35)
        assert command("depth", "--only", "one", out=tmp_path / "stopped") == 130
    assert rows_in(tmp_path / "stopped") == []
    assert "stopped" in capsys.readouterr().err
    assert (tmp_path / "stopped" / "depth.md").exists()
    assert command("depth", "--only", "one", out=tmp_path / "stopped") == 0
    for one, other in zip(rows_in(tmp_path / "whole"), rows_in(tmp_path / "stopped"), strict=True):
        for name in ("loss", "iterations", "best_iteration", "rmse", "replay_rmse"):
            assert one[name] == other[name], name


def test_a_larger_budget_goes_on_from_a_smaller_one(short, tmp_path, monkeypatch, ticking):
    begun = []
    train = running.train

    def noted(*arguments, **options):
        begun.append(options["resume"])
        return train(*arguments, **options)

    monkeypatch.setattr(running, "train", noted)
    for budget in ("0.2", "0.4", "none"):
        assert command("depth", "--only", "one", "--budget", budget, out=tmp_path) == 0
    rows = rows_in(tmp_path)
    assert begun == [False, True, True]
    assert rows[0]["iterations"] < rows[1]["iterations"] < rows[2]["iterations"]
    shown = [line[1] for line in report.lines(reproduce_paper.TABLES["depth"], rows)]
    assert shown[1:3] == ["fast, guided, stopped at 0.2 s", "fast, guided, stopped at 0.4 s"]
    assert report.longest(rows) == [rows[2]]


def test_a_case_that_fails_does_not_stop_the_others(short, tmp_path, monkeypatch, capsys):
    train = running.train

    def failing(trainer, **options):
        if trainer.config.width == 4:
            raise FloatingPointError("not finite")
        return train(trainer, **options)

    monkeypatch.setattr(running, "train", failing)
    assert command("depth", out=tmp_path) == 1
    assert "one failed: FloatingPointError: not finite" in capsys.readouterr().out
    assert [row["case"] for row in rows_in(tmp_path)] == ["other"]


# The section of the page of results


def test_the_page_of_results_gets_a_section(short, tmp_path):
    assert command("depth", "--only", "one", out=tmp_path) == 0
    section = report.readme_section(rows_in(tmp_path), [reproduce_paper.TABLES["depth"]])
    text = "# X\n\n<!-- paper: written by scripts/readme.py -->\n<!-- end -->\n\nend"
    for _ in range(2):  # once into an empty place, once in place of the former
        text = readme.replaced(text, "paper", section)
    assert text.count("| one | the paper |") == 1
    assert "| other |" not in text
    assert "Measured on 20" in text
    assert str(tmp_path) not in text
    assert text.endswith("end")
    assert report.readme_section([], TABLES.values()) == ""


# Bad input


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["depth", "--only", "9x21"], "unknown case '9x21' of depth; known are 15x30, 15x20"),
        (["weights", "--only", "8"], "unknown case '8' of weights; known are 1, 2"),
        (["width"], "unknown table 'width'; known are depth, activation, weights, examples"),
        (
            ["depth", "--preset", "slow"],
            "preset='slow'; expected one of guided, plain, transfer, paper",
        ),
        (["depth", "--budget", "long"], "budget='long'; expected CPU seconds or none"),
        (["depth", "--budget", "nan"], "budget=nan; expected None or positive seconds"),
        (["depth", "--budget", "-1"], "budget=-1.0; expected None or positive seconds"),
        (["depth", "--seed", "-1"], "seed=-1; expected a whole number from 0 to"),
        (["depth", "--jobs", "0"], "jobs=0; expected at least 1"),
        (["depth", "--out", "/dev/null/x"], "cannot write to folder /dev/null/x"),
    ],
)
def test_bad_input_is_one_line(arguments, message, capsys, tmp_path):
    given = arguments if "--out" in arguments else [*arguments, "--out", str(tmp_path)]
    assert reproduce_paper.main(given) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("line", ['{"key": "a', "[]", json.dumps({"key": "a"})])
def test_a_damaged_results_file_is_one_line(line, capsys, tmp_path):
    (tmp_path / "results.jsonl").write_text(line + "\n")
    assert command("depth", out=tmp_path) == 2
    error = capsys.readouterr().err
    assert "results.jsonl, line 1, is cut off or no result" in error
    assert error.count("\n") == 1


def test_the_comparison_keeps_what_is_there_and_shows_both(tmp_path, capsys, monkeypatch):
    configured = comparison.Comparison.config

    def fewer(self, method):
        config = configured(self, method)
        few = {} if method.startswith("pinn_obs") else {"trajectories": 40, "samples": 40}
        return replace(config, iterations=10, **few)

    monkeypatch.setattr(comparison.Comparison, "config", fewer)
    source = EpisodeSource("ReverseDuffing", noise_std=0.0, dt=0.2)
    monkeypatch.setattr(comparison, "compared", lambda: source)
    options = ["comparison", "--records", "2", "--budget", "none", "--out", str(tmp_path)]
    assert reproduce_paper.main(options) == 0
    shown = capsys.readouterr().out
    assert "kkl_autoencoder: trained in" in shown
    assert "record 1 of 2" in shown
    text = (tmp_path / "comparison.md").read_text()
    assert "| pinn_obs | the paper | not stated | not stated | 5.56e-06 | 0.00236 |" in text
    assert "z₀ = 0" in text
    for method in comparison.METHODS:
        for statistic in ("mean", "median"):
            guided = " (guided by a smoother)" if method.startswith("pinn_obs") else ""
            assert f"| {method}{guided} | ours | from 10 s | {statistic} |" in text
    assert reproduce_paper.main(options) == 0
    assert "trained in" not in capsys.readouterr().out
    assert (tmp_path / "comparison.md").read_text() == text
    assert reproduce_paper.main(["comparison", "--records", "0"]) == 2
    assert "records=0; expected at least 1" in capsys.readouterr().err


def test_the_compared_records_are_the_env_s():
    record, x = comparison.played(2)
    np.testing.assert_array_equal(record.y, x[..., :1])
    env = gym.make("pinnobs/ReverseDuffing-v0", noise_std=0.0)
    _, info = env.reset(seed=1)
    np.testing.assert_array_equal(x[1, 0], info["state"])
