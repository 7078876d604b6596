"""Processes of runs: clients, their workers, and those of Dask."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hardening.runs import Run

PATIENCE = 120.0
"""Seconds after which a process is taken to hang."""


@contextmanager
def started(run: Run, *more: str) -> Iterator[subprocess.Popen[str]]:
    """Yield a client that runs, in a session of its own that is ended afterwards."""
    client = _started(run.out.parent, *run.command, *more)
    try:
        yield client
    finally:
        _end(client)


def _started(folder: Path, *command: str) -> subprocess.Popen[str]:
    pipe, kept = subprocess.PIPE, {**os.environ, "PYTHONUNBUFFERED": "1"}
    return subprocess.Popen(
        command,
        cwd=folder,
        env=kept,
        stdout=pipe,
        stderr=pipe,
        text=True,
        start_new_session=True,
        preexec_fn=_take_ctrl_c,
    )


def _take_ctrl_c() -> None:
    """Let Ctrl-C interrupt this process, even if it is ignored by the one that starts it, as it is
    under nohup."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _end(process: subprocess.Popen[str]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.communicate()


def until(found: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """Return what is found, once there is something; None if there never is."""
    deadline = time.monotonic() + patience
    while not (result := found()) and time.monotonic() < deadline:
        time.sleep(0.02)
    return result


def children(pid: int) -> list[int]:
    """Return the processes of a session but its first, on Linux."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, session, *_ = stat.read_text().rpartition(")")[2].split()
            if int(session) == pid and state != "Z":
                found.append(int(stat.parent.name))
    return [each for each in found if each != pid]


def workers(client: subprocess.Popen[str]) -> list[int]:
    """Return the worker processes of a client."""
    found = []
    for pid in children(client.pid):
        with suppress(OSError):
            if b"loky" in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


@contextmanager
def dask(folder: Path) -> Iterator[tuple[subprocess.Popen[str], str, list[subprocess.Popen[str]]]]:
    """Yield a scheduler, its address, and two workers."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    python, file = (sys.executable, "-m"), folder / "scheduler.json"
    place = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file))
    scheduler = _started(folder.parent, *python, "distributed.cli.dask_scheduler", *place)
    processes = [scheduler]

    def address() -> str:
        with suppress(FileNotFoundError, json.JSONDecodeError):  # not there, or not yet whole
            return json.loads(file.read_text())["address"]
        return ""

    try:
        found = until(address)
        worker = (*python, "distributed.cli.dask_worker", found, "--nthreads", "1", "--no-nanny")
        for _ in range(2):
            processes.append(_started(folder.parent, *worker, "--no-dashboard"))
        yield scheduler, found, processes[1:]
    finally:
        for process in processes:
            _end(process)
