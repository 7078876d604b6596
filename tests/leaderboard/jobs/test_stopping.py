"""Signals that ask a run to stop."""

import os
import signal
import subprocess
import sys
from contextlib import suppress

import pytest

from pinnobs_gym.cli import main
from pinnobs_gym.leaderboard.jobs.stopping import Stopped, interruptible, stoppable
from pinnobs_gym.scoring import rows

PLUG_IN = '''
import os, signal, sys
from pinnobs_gym.estimators.ekf import EKF


class Asks(EKF):
    """Asks its process to end, and does not let it."""

    name = "zasks"

    def run(self, record):
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except BaseException:
            sys.exit(0)


class Exits(EKF):
    name = "exits"

    def run(self, record):
        sys.exit(0)


class Unmade(EKF):
    name = "unmade"

    def __post_init__(self):
        sys.exit(0)
'''


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "asking_module.py").write_text(PLUG_IN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_a_terminated_leaderboard_keeps_its_rows_and_says_so_in_one_line(folder, capsys):
    own = [f"asking_module:{name}" for name in ("Exits", "Unmade", "Asks")]
    names = ["ekf", *own, "open_loop"]
    played = ["--systems", "ReverseDuffing", "--condition", "nominal", "--episodes", "1"]
    command = ["leaderboard", *played, "--jobs", "1", "--out", "lb", "--estimators", *names]
    assert main(command) == 143
    printed = capsys.readouterr().err
    assert printed == "pinnobs: stopped by SIGTERM; what was written is kept\n"
    stored = rows.load(folder / "lb" / "rows.jsonl")
    assert [row["estimator"] for row in stored.rows] == ["ekf"]
    failed = [(row["estimator"], row["error"]) for row in stored.failures]
    assert failed == [("exits", "SystemExit: 0"), ("unmade", "SystemExit: 0")]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_plug_in_that_exits_is_an_error_of_any_command(folder, capsys):
    command = ["evaluate", "--system", "ReverseDuffing", "--episodes", "1", "--estimator"]
    assert main([*command, "asking_module:Exits"]) == 1
    assert capsys.readouterr().err.startswith("pinnobs: error: SystemExit: 0 (")


def test_a_job_cannot_swallow_ctrl_c():
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    @interruptible()
    def swallow():
        with suppress(BaseException):
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        swallow()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_second_signal_does_not_interrupt_the_cleanup(number):

    @stoppable()
    def signal_twice():
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)

    with pytest.raises(Stopped) as stopped:
        signal_twice()
    assert stopped.value.status == 128 + number
    assert signal.getsignal(number) is signal.SIG_DFL


def test_what_is_ignored_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as by nohup
    try:
        with stoppable():
            signal.raise_signal(signal.SIGHUP)
    finally:
        signal.signal(signal.SIGHUP, before)


DEAF = """
import os, signal, sys
from pinnobs_gym.leaderboard.jobs import stopping
stopping.GRACE = 0.1
with stopping.stoppable():
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.pause()
"""
THREAD = """
import threading
from pinnobs_gym.cli import ending
ending.GRACE = 0.1
threading.Thread(target=threading.Event().wait).start()
ending.end(3)
"""


@pytest.mark.parametrize(("program", "status"), [(DEAF, 143), (THREAD, 3)])
def test_a_process_that_would_not_end_ends(program, status):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True)
    assert done.returncode == status, done.stderr
