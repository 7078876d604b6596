"""Tuned settings: their files, and what an estimator that has them is called."""

import json
import sys
from dataclasses import replace

import pytest
from damage import damaged, is_one_line_about

from pinnobs_gym.cli import main
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.files.seal import sealed
from pinnobs_gym.leaderboard.jobs import plan
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.scoring import rows, tuned_file
from pinnobs_gym.scoring.evaluation import evaluate
from pinnobs_gym.scoring.tuned import is_tuned, required_settings, tuned_settings
from pinnobs_gym.scoring.tuned_file import TunedEntry, path_of, read, store
from pinnobs_gym.systems import SYSTEMS

SOURCE = """
from dataclasses import dataclass
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing

@dataclass(frozen=True)
class Spring(ReverseDuffing):
    pass
"""
ENTRY = TunedEntry(
    env_id="pinnobs/Spring-v0",
    setup="benchmark",
    estimator="ekf",
    settings={"assumed_noise": 0.0625},
    error=0.01,
    default_error=0.02,
    trials=5,
    episodes=8,
    condition="nominal",
    versions={"numpy": "2"},
    date="2030-01-02",
)
TUNED = sealed(vars(ENTRY))


@pytest.fixture
def spring(tmp_path, monkeypatch):
    """A system in a file of the user's, in the working folder."""
    (tmp_path / "springs.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    yield SYSTEMS.resolve("springs:Spring")
    del sys.modules["springs"]


def test_a_file_has_one_entry_for_each_setup_and_estimator(spring, tmp_path):
    path = path_of(spring)
    assert path == tmp_path / "Spring.tuned.json"
    assert read(path) == ()
    other = replace(ENTRY, setup="paper")
    for entry in (replace(ENTRY, error=0.5), other, ENTRY):
        assert store(spring, entry) == path
    assert read(path) == (ENTRY, other)
    assert json.loads(path.read_text()) == [TUNED, sealed(TUNED | {"setup": "paper"})]
    later = replace(ENTRY, env_id="pinnobs/Spring-v1")
    store(spring, later)  # what was found for another version is of no use
    assert read(path) == (later,)
    assert {each.name for each in tmp_path.iterdir()} - {"__pycache__"} == {"springs.py", path.name}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "Expecting property name"),
        ("{}", "expected a list of entries"),
        ("[3]", "an entry with 3; expected condition, date, "),
        (json.dumps([sealed(TUNED | {"more": 1})]), "'more'"),
        (json.dumps([sealed(TUNED | {"trials": 1.5})]), "trials=1.5; expected a whole number"),
        (json.dumps([sealed(TUNED | {"settings": [1]})]), "settings=[1]; expected"),
        (json.dumps([TUNED | {"error": 0.001}]), "their digest differs"),
        ("[" * 500 + "]" * 500, "nested deeper"),
    ],
)
def test_a_damaged_file_is_named_in_one_line(spring, capsys, text, message):
    path_of(spring).write_text(text)
    assert main(["evaluate", "--system", "springs:Spring", "--tuned"]) == 2
    printed = capsys.readouterr().err
    assert str(path_of(spring)) in printed
    assert message in printed
    assert len(printed.splitlines()) == 1
    with pytest.raises(ValueError, match="cannot read tuned settings"):
        store(spring, ENTRY)
    assert path_of(spring).read_text() == text


def test_every_flipped_bit_of_a_file_is_noticed(spring):
    path = store(spring, ENTRY)
    refused, same = [], 0
    for change in damaged(path, 200):
        tuned_file._read.cache_clear()  # changes within one tick of the clock
        try:
            assert read(path) == (ENTRY,), change
            same += 1
        except ValueError as error:
            refused.append(error)
    assert len(refused) > 100
    assert all(is_one_line_about(error, path) for error in refused)


def test_settings_are_those_of_the_version_the_setup_and_the_estimator(spring):
    game = Game.of(spring)
    assert tuned_settings(EKF, game) is None
    store(spring, ENTRY)
    assert tuned_settings(EKF, game) == {"assumed_noise": 0.0625}
    assert tuned_settings(EKF, Game.of(spring, condition="noise5")) == {"assumed_noise": 0.0625}
    assert tuned_settings(EKF, Game.of(spring, "paper")) is None
    assert tuned_settings(ESTIMATORS.resolve("ukf"), game) is None
    assert tuned_settings(EKF, Game.of("ReverseDuffing")) != {"assumed_noise": 0.0625}
    store(spring, replace(ENTRY, settings={"assumed_noise": EKF.assumed_noise}))
    assert tuned_settings(EKF, game) is None  # these are the defaults


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"assumed_noise": 0.0625}, True),
        ({"assumed_noise": 0.0625, "patience": EKF.patience}, True),
        ({"assumed_noise": 0.0625, "huber": 2.0}, False),
        ({"assumed_noise": 0.0626}, False),
        ({"huber": 2.0}, False),
        ({}, False),
    ],
)
def test_tuned_is_what_has_all_of_these_settings_and_no_others(spring, options, expected):
    store(spring, ENTRY)
    assert is_tuned(EKF, options, Game.of(spring)) is expected


def test_rows_say_that_an_estimator_is_tuned(spring):
    store(spring, ENTRY)
    (tuned,) = evaluate("ekf", "Spring", episodes=1, tuned=True)
    assert tuned["estimator"] == "ekf, tuned"
    assert tuned["knows"] == ["model", "prior", "noise", "tuned"]
    assert tuned["settings"] == {}
    assert tuned["options"]["assumed_noise"] == 0.0625
    given = EKF(spring(), assumed_noise=0.0625, noise_std=0.5)
    (row,) = evaluate(given, "Spring", episodes=1)
    assert (row["estimator"], row["settings"]) == ("ekf, tuned", {"noise_std": 0.5})
    (plain,) = evaluate("ekf", "Spring", episodes=1)
    assert (plain["estimator"], "tuned" in plain["knows"]) == ("ekf", False)
    assert plain["nrmse"] != tuned["nrmse"]
    (row,) = evaluate("ekf", "Spring", episodes=1, options={"assumed_noise": 0.0625, "huber": 2.0})
    assert (row["estimator"], len(row["settings"])) == ("ekf", 2)


def test_what_is_not_stored_is_an_error_that_names_the_command(spring):
    expected = (
        "no tuned settings of ekf are stored with Spring for setup 'paper'; they are found by: "
        "pinnobs tune ekf --system springs:Spring --setup paper --store"
    )
    with pytest.raises(ValueError, match=expected):
        evaluate("ekf", "Spring", setup="paper", tuned=True)
    with pytest.raises(ValueError, match="'pinn_gain' is trained"):
        evaluate("pinn_gain", "Spring", tuned=True)
    for estimator, options in (("ekf", {"huber": 1.0}), (EKF(spring()), None)):
        with pytest.raises(ValueError, match=r"^tuned settings and .*; expected one of them"):
            evaluate(estimator, "Spring", tuned=True, options=options)
    store(spring, replace(ENTRY, settings={"noise": 1}))
    with pytest.raises(ValueError, match=r"Spring\.tuned\.json: settings of ekf: setting 'noise'"):
        required_settings(EKF, Game.of(spring))


def test_the_command_stores_what_evaluate_takes(spring, tmp_path, capsys):
    command = ["tune", "ekf", "ukf", "--system", "springs:Spring", "--episodes", "4", "--store"]
    assert main([*command, "--trials", "6"]) == 0
    printed = capsys.readouterr().out
    found = {entry.estimator: entry for entry in read(path_of(spring))}
    assert "ekf" in found  # its default is far from the best
    assert printed.count(f"stored: {path_of(spring)}") == len(found)
    assert ("ukf" in found) != ("was found; nothing is stored" in printed)
    for name, entry in found.items():
        assert entry.error < entry.default_error
        assert (entry.trials, entry.episodes, entry.condition) == (6, 4, "nominal")
        own = ["--system", "springs:Spring", "--estimator", name, "--episodes", "2"]
        assert main(["evaluate", *own, "--tuned"]) == 0
        by_hand = [f"{setting}={value}" for setting, value in entry.settings.items()]
        assert main(["evaluate", *own, "--set", *by_hand]) == 0
        assert "2 of 2 episodes taken from" in capsys.readouterr().out  # the same estimator
    assert {row["estimator"] for row in rows.read(tmp_path / "runs/evaluate/rows.jsonl")} == {
        f"{n}, tuned" for n in found
    }
    assert main(["evaluate", *own, "--tuned", "--set", "huber=1"]) == 2
    assert "--tuned and --set; expected one of them" in capsys.readouterr().err


def test_a_suite_plays_what_is_stored_and_only_once(spring, tmp_path):
    store(spring, ENTRY)
    entries = (Entry("ekf"), Entry("ekf", tuned=True), Entry("ekf", "best", tuned=True))
    systems = ("springs:Spring", "Academic")
    path = tmp_path / "rows.jsonl"

    def run(suite):
        jobs = plan.left(jobs_of(suite, tmp_path), rows.load(path), False)[0]
        for job in jobs:
            job.run()
        return [job.known for job in jobs]

    suite = Suite(systems[:1], entries, episodes=2)
    assert run(suite) == [frozenset()] * 3
    assert [len(known) for known in run(suite)] == [2, 2, 2]
    found = {row["estimator"]: "tuned" in row["knows"] for row in rows.read(path)}
    assert found == {"ekf": False, "ekf, tuned": True, "best": True}
    assert len(rows.read(path)) == 6
    # The same settings, given one by one, are the same estimator.
    by_hand = Entry("ekf", settings={"assumed_noise": 0.0625})
    assert [len(known) for known in run(Suite(systems[:1], (by_hand,), episodes=2))] == [2]
    with pytest.raises(ValueError, match="no tuned settings of 'sliding_mode' are stored with any"):
        jobs_of(Suite(systems, (Entry("sliding_mode", tuned=True),)), tmp_path)
    with pytest.raises(ValueError, match="'open_loop' declares no settings to search"):
        jobs_of(Suite(systems, (Entry("open_loop", tuned=True),)), tmp_path)


def test_a_suite_without_a_list_also_plays_what_is_tuned(spring, tmp_path):
    store(spring, ENTRY)
    jobs = jobs_of(Suite(("springs:Spring",), conditions=("nominal",)), tmp_path)
    assert [job.called for job in jobs if job.called.endswith(", tuned")] == ["ekf, tuned"]
    assert [job.called for job in jobs].count("ekf") == 1


@pytest.mark.parametrize("name", SYSTEMS.sources)
def test_settings_that_are_shipped_are_taken_and_better_than_the_defaults(name):
    cls = SYSTEMS.resolve(name)
    game = Game.of(cls)
    entries = {entry.estimator: entry for entry in read(path_of(cls))}
    assert {"ekf", "ukf", "robust_ekf", "mhe"} <= entries.keys()
    for estimator, entry in entries.items():
        found = ESTIMATORS.resolve(estimator)
        assert entry.env_id == game.name.env_id
        assert (entry.setup, entry.condition) == ("benchmark", "nominal")
        assert entry.settings.keys() == found.tunable.keys()
        assert entry.error < entry.default_error
        assert required_settings(found, game) == entry.settings
