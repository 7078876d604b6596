"""Time limits of jobs."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from simple_job import Simple

from pinnobs_gym.leaderboard.jobs import worker
from pinnobs_gym.leaderboard.jobs.interface import Origin, Parcel
from pinnobs_gym.leaderboard.jobs.plan import jobs_of
from pinnobs_gym.leaderboard.jobs.time_limit import TIME_LIMIT, exceeded, limited
from pinnobs_gym.leaderboard.suites import Entry, Suite

HANGS = """
import sys
from pathlib import Path
from pinnobs_gym.leaderboard.jobs.time_limit import limited

def job():
    with limited(0.2, Path(sys.argv[1])):
        sum(range(10**18))

job()
"""


def test_code_that_holds_the_lock_of_the_interpreter_is_ended(tmp_path):
    program, path = tmp_path / "hangs.py", tmp_path / "1.running"
    program.write_text(HANGS)
    done = subprocess.run([sys.executable, program, path], capture_output=True)
    assert done.returncode == 1
    line = exceeded(path, "hangs.py")
    assert line == "no end within the time limit of 0.2 s; it was in job (hangs.py, line 8)"


def test_a_job_in_time_leaves_nothing(tmp_path):
    path = tmp_path / "1.running"
    with limited(1000.0, path):
        assert path.exists()
        assert exceeded(path, "x.py") is None
    assert not path.exists()
    with limited(1e9, path), limited(None, path):  # longer than any timer
        assert not path.exists()


@pytest.fixture
def late(tmp_path):
    """The mark of a client in whose folder job 3 has exceeded its limit."""
    mark = tmp_path / ".running"
    mark.mkdir()
    lines = ["5", "Timeout (0:00:05)!", "Thread 0x1 (most recent call first):"]
    library = Path(os.__file__).parent
    lines += [f'  File "{library}/threading.py", line 3 in wait', ""]
    lines += ["Thread 0x2 (most recent call first):"]
    lines += [f'  File "{library}/re/__init__.py", line 7 in match']
    lines += ['  File "/home/me/mine.py", line 12 in update']
    lines += [f'  File "{worker.__file__}", line 9 in attempt']
    (mark / "3.running").write_text("\n".join(lines))
    return mark


def test_another_worker_does_not_run_a_job_that_was_late(tmp_path, late):
    """As on Dask, which gives a job whose process has ended to another worker."""
    origin = Origin(1, "client", str(tmp_path), late, children=False)
    outcome = worker.attempt(3, Parcel.of(Simple(tmp_path, 3)), origin)
    line = "no end within the time limit of 5 s; it was in update (mine.py, line 12)"
    assert (outcome.error, outcome.unrecorded) == (line, True)
    assert not (tmp_path / "notes").exists()  # the client records it


def test_the_limit_of_a_suite_and_that_without_one(tmp_path):
    suite = Suite(
        systems=("ReverseDuffing",),
        estimators=(Entry("ekf"), Entry("pinn_gain")),
        conditions=("nominal",),
        budgets=(100.0,),
    )
    limits = {job.estimator: job.time_limit for job in jobs_of(suite, tmp_path)}
    assert limits == {"ekf": TIME_LIMIT, "pinn_gain": TIME_LIMIT + 400.0}
    limited = jobs_of(suite.changed(timeout=60), tmp_path)
    assert {job.time_limit for job in limited} == {60}
    assert limited[0].digest == replace(limited[0], time_limit=None).digest
    with pytest.raises(ValueError, match=r"timeout=-1\.0; expected a positive number of seconds"):
        suite.changed(timeout=-1.0)
