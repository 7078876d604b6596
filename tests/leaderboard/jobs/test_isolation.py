"""Plug-ins that raise, change or leave what concerns other jobs."""

import asyncio
import gc
import locale
import os
import random
import signal
import sys
import threading
import time
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from hostile_job import Hostile, Unpicklable, Unreadable
from simple_job import Simple
from waiting import until

from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.jobs.worker import attempt_here
from pinnobs_gym.registry import error_line


@dataclass(frozen=True)
class Calls(Simple):
    """A job that calls a function."""

    call: Any = None

    def run(self):
        self.call()


@pytest.fixture
def job(tmp_path):
    return lambda call: Calls(tmp_path, 0, call=call)


class Own(BaseException):
    pass


def deep(number=0):
    return deep(number + 1)


def fill_memory():
    return np.ones(10**15)


def raising(error):
    def call():
        raise error

    return call


@pytest.mark.parametrize(
    ("call", "error"),
    [
        (sys.exit, "SystemExit"),
        (raising(SystemExit("done")), "SystemExit: done"),
        (raising(Own("a\x1b[31mb\nc")), "Own: a [31mb c"),
        (raising(KeyboardInterrupt()), "KeyboardInterrupt"),
        (raising(GeneratorExit()), "GeneratorExit"),
        (raising(asyncio.CancelledError()), "CancelledError"),
        (raising(Unreadable()), "Unreadable: an error without a readable text"),
        (deep, "RecursionError: maximum recursion depth exceeded"),
        (fill_memory, "MemoryError: Unable to allocate"),
        (raising(ValueError("\udc80" + "a" * 2000)), "ValueError: aa"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_whatever_a_job_raises_it_has_failed(job, tmp_path, call, error):
    outcome = attempt_here(job(call))
    assert outcome.error.startswith(error)
    assert len(outcome.error) <= 1000
    assert not outcome.ends_all
    assert (tmp_path / "notes").read_text() == f"0 {outcome.error}\n"


def test_an_error_whose_class_has_no_readable_name_is_a_line():
    class Nameless(type):
        @property
        def __name__(cls):
            raise RuntimeError

    error = Nameless("Error", (Exception,), {})("text")
    assert error_line(error) == "an error without a name: text"


def state():
    """What a job may not change for the next one."""
    return {
        "folder": os.getcwd(),
        "environment": dict(os.environ),
        "modules": list(sys.path),
        "recursion": sys.getrecursionlimit(),
        "garbage": gc.isenabled(),
        "locale": locale.setlocale(locale.LC_ALL),
        "warnings": list(warnings.filters),
        "errors": np.geterr(),
        "printing": np.get_printoptions()["precision"],
        "signals": [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)],
        "timer": signal.getitimer(signal.ITIMER_REAL)[0],
        "type": torch.get_default_dtype(),
        "gradients": torch.is_grad_enabled(),
        "random": (random.getstate(), np.random.get_state()[1].tolist()),  # noqa: NPY002
        "streams": (sys.stdout, sys.stderr, os.fstat(1).st_ino, os.fstat(2).st_ino),
    }


def change_everything():
    os.chdir("/")
    os.environ["PINNOBS_TEST"] = "changed"
    sys.path.insert(0, "/nowhere")
    sys.setrecursionlimit(12345)
    gc.disable()
    locale.setlocale(locale.LC_ALL, "C.UTF-8" if locale.setlocale(locale.LC_ALL) == "C" else "C")
    warnings.simplefilter("ignore")
    np.seterr(all="raise")
    np.set_printoptions(precision=2)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, signal.SIG_IGN)
    signal.setitimer(signal.ITIMER_REAL, 1000.0)
    torch.set_default_dtype(torch.float64)
    torch.set_grad_enabled(False)
    random.seed(5)
    np.random.seed(5)  # noqa: NPY002
    sys.stdout.close()
    sys.stderr.close()
    os.close(1)
    os.close(2)


def test_what_a_job_changes_is_undone(job, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = state()
    assert attempt_here(job(change_everything)).error is None
    assert state() == before


def test_a_job_that_deletes_its_folder_is_one_job(job, tmp_path, monkeypatch):
    inside = tmp_path / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)
    assert attempt_here(job(inside.rmdir)).error is None
    assert attempt_here(job(lambda: None)).error is None


def test_every_job_draws_the_same_global_random_numbers(job):
    drawn = []

    def draw():
        drawn.append((random.random(), np.random.rand(), torch.rand(1).item()))  # noqa: NPY002

    for _ in range(2):
        attempt_here(job(draw))
        random.random(), np.random.rand(), torch.rand(1)  # noqa: NPY002
    assert drawn[0] == drawn[1]


def test_what_a_job_prints_is_no_result(job, capsys):
    attempt_here(job(lambda: print("seen")))
    printed = capsys.readouterr()
    assert (printed.out, printed.err) == ("", "seen\n")


def test_a_stream_that_was_closed_is_open_again(job, monkeypatch):
    with os.fdopen(os.dup(1), "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "__stdout__", stream)
        attempt_here(job(lambda: sys.__stdout__.close()))
        assert not sys.stdout.closed
        assert sys.stdout.fileno() == 1


def test_a_forked_process_goes_no_further_than_its_job(job):
    def fork():
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of threads
            forked.append(os.fork())

    forked = []
    attempt_here(job(fork))
    assert os.waitpid(forked[0], 0) == (forked[0], 0)


def test_what_a_job_leaves_running_is_known(job):
    over = threading.Event()
    assert attempt_here(job(lambda: threading.Thread(target=over.wait).start())).leftovers
    over.set()
    daemon = threading.Thread(target=time.sleep, args=(0.1,), daemon=True)
    assert not attempt_here(job(daemon.start)).leftovers


def is_running(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    with open(f"/proc/{pid}/stat") as file:
        return file.read().rpartition(")")[2].split()[0] != "Z"


def test_in_worker_processes(tmp_path):
    """One run of two workers for all: processes start slowly."""
    kinds = ("leave thread", "leave process", "unreadable", "exit", "hang", "work")
    jobs = [Hostile(tmp_path, i, what, time_limit=30.0) for i, what in enumerate(kinds)]
    jobs[4] = Hostile(tmp_path, 4, "hang", time_limit=1.0)
    jobs.append(Hostile(tmp_path, 6, "work", cargo=Unpicklable()))
    ended = {job.number: error for job, error, _ in Engine(Workers(2)).run(jobs)}
    line = ended.pop(4)
    assert line.startswith("no end within the time limit of 1 s; it was in hang (hostile_job.py, ")
    unreadable = "Unreadable: an error without a readable text"
    unsent = "it cannot be sent to a worker: OSError: no way"
    expected = {0: None, 1: None, 2: unreadable, 3: "SystemExit", 5: None, 6: unsent}
    assert ended == expected
    notes = dict(n.split(" ", 1) for n in (tmp_path / "notes").read_text().splitlines())
    done_by = {notes.pop(number) for number in "015"}
    assert len(done_by) == 3  # what leaves something running is the last job of its process
    assert notes == {"2": unreadable, "3": "SystemExit", "4": line, "6": unsent}
    left = [int(note.split()[-1]) for note in sorted(done_by)]
    child = int((tmp_path / "child").read_text())
    until(lambda: not is_running(child))
    assert sum(map(is_running, left)) <= 1  # the process of job 5 is ready for another run
