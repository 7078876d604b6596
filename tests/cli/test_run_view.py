"""The progress of many jobs: when lines are printed, and the time left."""

import time

import pytest

from pinnobs_gym.cli import run_view
from pinnobs_gym.cli.run_view import Kind, RunView, TimeLeft

TRAINING, QUICK, SLOW = Kind("trainings", "kkl"), Kind("playing", "ekf"), Kind("playing", "mhe")


class Idle:
    """An engine that runs nothing."""

    processes = 2
    running = ()


def test_the_time_left_counts_each_kind_of_job_by_itself():
    """A tenth of the jobs are trainings of 50 s, all others take a second: 400 jobs do not take
    400 times 50 s, though only trainings have ended."""
    left = TimeLeft([TRAINING] * 40 + [QUICK] * 400)
    assert left.estimate(2) is None
    for _ in range(4):
        left.ended(TRAINING, 50.0)
    assert left.estimate(2) == (36 * 50 / 2, False)  # a lower bound: no other job has ended
    left.ended(QUICK, 1.0)
    assert left.estimate(2) == ((36 * 50 + 399) / 2, True)


def test_a_kind_of_which_none_has_ended_is_like_the_others_of_its_part():
    left = TimeLeft([QUICK, QUICK, SLOW])
    left.ended(QUICK, 3.0)
    assert left.estimate(1) == (6.0, True)
    left.ended(SLOW, 10.0)
    assert left.estimate(1) == (3.0, True)
    left.ended(QUICK, 3.0)
    assert left.estimate(1) == (0.0, True)


def test_a_pipe_gets_a_line_at_once_and_when_no_job_ends_for_long(capsys, monkeypatch):
    monkeypatch.setattr(RunView, "SILENT", 0.01)
    with RunView([TRAINING, QUICK], Idle()) as view:
        first = capsys.readouterr().out
        assert first == "jobs: 2 to run (1 trainings, 1 playing)\n"
        deadline = time.monotonic() + 30
        while not (later := capsys.readouterr().out) and time.monotonic() < deadline:
            time.sleep(0.01)
        assert later.startswith("jobs: 0 of 2 done, 0 failed, 0 running, 0 s so far\n")
        view.ended("a", TRAINING, None, 3.0)
        view.ended("b", QUICK, "ValueError: no", 1.0)
    assert capsys.readouterr().out.endswith("jobs: 1 of 2 done, 1 failed, 0 s so far\n")
    spent = view.seconds()
    assert spent["trainings"] == pytest.approx(3 * spent["playing"])


def test_nothing_to_run_prints_nothing(capsys):
    with RunView([], Idle()) as view:
        pass
    assert capsys.readouterr().out == ""
    assert view.seconds() == {}


def test_a_duration_is_in_one_unit():
    assert [run_view._duration(s) for s in (0, 119, 120, 7199, 7200)] == [
        *("0 s", "119 s", "2 min", "120 min", "2 h"),
    ]
