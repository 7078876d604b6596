"""The engine on real processes, which are killed while they work."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from simple_job import Simple
from waiting import PATIENCE, heed_ctrl_c, until

from pinnobs_gym.cli import main
from pinnobs_gym.files import CannotWrite
from pinnobs_gym.leaderboard.jobs import cluster, worker
from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.jobs.interface import Origin, Parcel
from pinnobs_gym.scoring import rows

PLUG_IN = '''
import os
import time
from pathlib import Path
from pinnobs_gym.estimators.ekf import EKF


class Held(EKF):
    """Says in the working folder which process runs it, and waits there until it may go on."""

    name = "held"

    def run(self, record):
        Path(f"held-{os.getpid()}").touch()
        while not Path("go").exists():
            time.sleep(0.02)
        return super().run(record)
'''
PLAYED = ["--systems", "ReverseDuffing", "--episodes", "2", "--out", "lb"]
PLAYED += ["--estimators", "open_loop", "held_module:Held", "ekf"]
COMMAND = [sys.executable, "-m", "pinnobs_gym.cli", "leaderboard", *PLAYED]


def held(folder):
    """The process that is held."""
    return until(lambda: [int(path.name[5:]) for path in folder.glob("held-*")])[0]


def running(pid):
    status = Path(f"/proc/{pid}/stat")
    return status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z"


def facts(path):
    """Rows in an order of their own, without what differs from run to run."""
    aside = ("us_per_step", "date")
    shown = [{k: v for k, v in row.items() if k not in aside} for row in rows.read(path)]
    return sorted(json.dumps(row, sort_keys=True) for row in shown)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "held_module.py").write_text(PLUG_IN)
    return tmp_path


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The rows of a run that nothing befell."""
    folder = tmp_path_factory.mktemp("undisturbed")
    (folder / "held_module.py").write_text(PLUG_IN)
    (folder / "go").touch()
    with contextlib.chdir(folder):
        assert again() == 0
    return facts(folder / "lb" / "rows.jsonl")


@pytest.fixture
def started(folder):
    """Starts processes, and ends what is left of them."""
    processes = []

    def start(*command):
        processes.append(
            subprocess.Popen(
                [str(part) for part in command],
                cwd=folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
                preexec_fn=heed_ctrl_c,
            )
        )
        return processes[-1]

    yield start
    for process in processes:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def again():
    """The same command once more, in this process."""
    return main([*COMMAND[3:], "--jobs", "1"])


def test_a_killed_worker_ends_nothing(folder, started, undisturbed):
    client = started(*COMMAND, "--jobs", "2")
    os.kill(held(folder), signal.SIGKILL)
    (folder / "go").touch()
    printed, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 0, printed
    assert facts(folder / "lb" / "rows.jsonl") == undisturbed
    assert len((folder / "lb" / "rows.jsonl").read_text().splitlines()) == len(undisturbed)
    assert not list((folder / "lb").glob(".running-*"))


def test_a_killed_client_loses_nothing_that_was_finished(folder, started, undisturbed, capsys):
    client = started(*COMMAND, "--jobs", "2")
    at_work = held(folder)
    path = folder / "lb" / "rows.jsonl"
    until(lambda: path.exists() and len(rows.read(path)) == 4)  # of open_loop and ekf
    client.kill()
    client.wait()
    until(lambda: not running(at_work))
    before = rows.read(path)
    (folder / "go").touch()
    assert again() == 0
    assert facts(path) == undisturbed
    assert rows.read(path)[: len(before)] == before
    assert not list((folder / "lb").glob(".running-*"))


def test_ctrl_c_stops_at_once_and_keeps_what_was_finished(folder, started, undisturbed, capsys):
    client = started(*COMMAND, "--jobs", "2")
    at_work = held(folder)
    path = folder / "lb" / "rows.jsonl"
    until(lambda: path.exists() and rows.read(path))
    os.killpg(client.pid, signal.SIGINT)  # as a terminal does: workers get it, too
    printed, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 130
    assert printed.strip().splitlines()[-1].startswith("pinnobs: stopped; what was written")
    assert "Traceback" not in printed
    until(lambda: not running(at_work))
    (folder / "go").touch()
    assert again() == 0
    assert facts(path) == undisturbed


def test_ctrl_c_in_a_training_of_this_process_scores_nothing(folder, started):
    endless = f"preset = 'paper', transfer = false, iterations = {10**9}, patience = {10**9}"
    (folder / "endless.toml").write_text(
        "systems = ['Academic']\nbudgets = [1e9]\n"
        f"estimators = [{{name = 'pinn_obs_replay', settings = {{{endless}}}}}]\n"
    )
    client = started(*COMMAND[:4], "--suite", "endless.toml", "--out", "lb", "--jobs", "1")
    until(lambda: client.poll() is not None or list(folder.rglob("events.*")))
    client.send_signal(signal.SIGINT)
    printed, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 130, printed
    assert not list(folder.rglob("*.pt"))
    assert rows.read(folder / "lb" / "rows.jsonl") == []


@pytest.fixture
def dask(folder, started):
    """A Dask scheduler, its address, and two workers."""
    python = [sys.executable, "-m"]
    port = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    file = folder / "scheduler.json"
    scheduler = started(*python, "distributed.cli.dask_scheduler", *port, "--scheduler-file", file)

    def written():
        with contextlib.suppress(
            FileNotFoundError, json.JSONDecodeError
        ):  # not there, or not yet whole
            return json.loads(file.read_text())["address"]

    address = until(written)
    one = ["--nthreads", "1", "--no-nanny", "--no-dashboard"]
    for _ in range(2):
        started(*python, "distributed.cli.dask_worker", address, *one)
    return scheduler, address


def test_a_killed_scheduler_and_then_another_run(folder, started, dask, undisturbed, capsys):
    scheduler, address = dask
    client = started(*COMMAND, "--backend", "dask", "--scheduler", address)
    held(folder)
    path = folder / "lb" / "rows.jsonl"
    until(lambda: path.exists() and rows.read(path))
    scheduler.kill()
    printed, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 1
    last = printed.strip().splitlines()[-1]
    assert last.startswith("pinnobs: error: the Dask scheduler is gone")
    assert "Traceback" not in printed
    (folder / "go").touch()
    assert again() == 0
    assert facts(path) == undisturbed


def test_a_killed_dask_worker_ends_nothing(folder, started, dask, undisturbed):
    client = started(*COMMAND, "--backend", "dask", "--scheduler", dask[1])
    os.kill(held(folder), signal.SIGKILL)
    (folder / "go").touch()
    printed, _ = client.communicate(timeout=PATIENCE)
    assert client.returncode == 0, printed
    assert facts(folder / "lb" / "rows.jsonl") == undisturbed


def test_no_scheduler_is_one_line(folder, monkeypatch, capsys):
    monkeypatch.setattr(cluster, "CONNECT", 0.3)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
        assert main([*COMMAND[3:], "--backend", "dask", "--scheduler", address]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"pinnobs: error: no Dask scheduler at '{address}'")
    assert len(printed.splitlines()) == 1
    assert main([*COMMAND[3:], "--backend", "dask", "--scheduler", "nonsense"]) == 2
    assert "scheduler='nonsense'; expected an address" in capsys.readouterr().err


def test_a_job_that_kills_its_process_has_failed_and_the_others_are_done(tmp_path):
    kinds = {2: "die", 4: "fail"}
    jobs = [Simple(tmp_path, i, kinds.get(i, "work")) for i in range(9)]
    ended = {job.number: error for job, error, _ in Engine(Workers(2)).run(jobs)}
    assert ended.keys() == set(range(9))
    assert ended[2].startswith("its process died more than once (exit codes {")
    assert "SIGKILL(-9)" in ended[2]
    assert ended[4] == "RuntimeError: out of luck"
    assert all(ended[i] is None for i in ended.keys() - kinds.keys())
    notes = (tmp_path / "notes").read_text().splitlines()
    assert sorted(notes) == [f"{i} {ended[i] or 'done'}" for i in range(9)]  # none twice


def test_jobs_that_end_are_told_and_those_that_run_are_named(tmp_path):
    found = Engine(Workers(1))
    assert found.running == []
    names = []
    for job, error, _ in found.run([Simple(tmp_path, i) for i in range(3)]):
        assert error is None
        names.append((job.name, [other.name for other in found.running]))
    assert [name for name, _ in names] == ["job 0", "job 1", "job 2"]
    assert found.running == []


def test_what_cannot_be_written_ends_the_run(tmp_path):
    jobs = [Simple(tmp_path, 0), Simple(tmp_path, 1, "fill"), Simple(tmp_path, 2)]
    ended = Engine(Workers(1)).run(jobs)
    assert next(ended).job.number == 0
    with pytest.raises(CannotWrite, match="the disk is full"):
        next(ended)
    assert (tmp_path / "notes").read_text() == "0 done\n"


def test_a_worker_that_does_not_see_the_folder_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(worker, "SEEN_AFTER", 0.1)
    origin = Origin(1, "client", str(tmp_path), tmp_path / "elsewhere" / ".running", children=False)
    error, ends_all, *_ = worker.attempt(5, Parcel.of(Simple(tmp_path, 5)), origin)
    assert ends_all
    here = socket.gethostname()
    told = f"the worker on {here} does not see folder {tmp_path / 'elsewhere'} of client; expected"
    assert error.startswith(told)
    assert not (tmp_path / "notes").exists()


def test_a_job_whose_end_was_not_heard_of_is_not_run_again(tmp_path):
    mark = tmp_path / ".running"
    mark.mkdir()
    origin = Origin(1, "client", str(tmp_path), mark, children=False)
    for number, what, error in ((11, "work", None), (1, "fail", "RuntimeError: out of luck")):
        for _ in range(2):
            assert (
                worker.attempt(number, Parcel.of(Simple(tmp_path, number, what)), origin).error
                == error
            )
    notes = (tmp_path / "notes").read_text().splitlines()
    assert notes == ["11 done", "1 RuntimeError: out of luck"]
