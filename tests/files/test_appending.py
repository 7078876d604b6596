"""Files on an operating system with or without ``fcntl``, and locks of processes that died."""

import os
import subprocess
import sys
import threading

import pytest

from pinnobs_gym.files import append_lines, holding, is_held, locked, write_whole

WITHOUT_FCNTL = "import sys; sys.modules['fcntl'] = None\n"
"""As on Windows, where filelock warns of nothing."""
HOLD = """
import sys, time
from pathlib import Path
from pinnobs_gym.files import holding, locked
with {context}(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""
LOOK = """
import sys
from pathlib import Path
from pinnobs_gym.files import append_lines, is_held
path = Path(sys.argv[1])
print(is_held(path))
"""


def test_lines_begin_a_line_of_their_own(tmp_path):
    path = tmp_path / "deep" / "lines"
    append_lines(path, [{"a": 1}, {"a": float("inf")}])
    path.write_bytes(path.read_bytes() + b'{"a": ')
    append_lines(path, [{"a": 2}])
    assert path.read_bytes() == b'{"a": 1}\n{"a": null}\n{"a": \n{"a": 2}\n'


def test_what_does_not_fit_is_taken_back(tmp_path):
    class Full:
        """A disk that is full after 3 bytes."""

        def __init__(self, file):
            self.file, self.free = file, 3

        def write(self, data):
            written = self.file.write(data[: self.free])
            self.free -= written
            return written

        def __getattr__(self, name):
            return getattr(self.file, name)

    path = tmp_path / "file"
    path.write_bytes(b"whole\n")
    with locked(path) as file, pytest.raises(OSError, match="only 3 of 6 bytes fitted"):
        write_whole(Full(file), b"other\n")
    assert path.read_bytes() == b"whole\n"


def test_threads_take_turns(tmp_path):
    path = tmp_path / "file"
    inside, most = [], []

    def append(i):
        for _ in range(5):
            with locked(path) as file:
                inside.append(i)
                most.append(len(inside))
                write_whole(file, b"%d\n" % i)
                inside.pop()

    threads = [threading.Thread(target=append, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert max(most) == 1
    assert sorted(path.read_text().split()) == sorted("0123" * 5)


@pytest.mark.parametrize("prefix", ["", WITHOUT_FCNTL], ids=["fcntl", "no fcntl"])
@pytest.mark.parametrize("context", ["locked", "holding"])
def test_a_killed_process_blocks_nobody(tmp_path, prefix, context):
    path = tmp_path / "file"
    program = prefix + HOLD.format(context=context)
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", program, str(path)], stdout=subprocess.PIPE
    )
    assert process.stdout.readline() == b"held\n"
    command = [sys.executable, "-W", "ignore", "-c", prefix + LOOK, str(path)]
    assert subprocess.run(command, capture_output=True, check=True).stdout == b"True\n"
    process.kill()
    process.communicate()
    command[-2] += "append_lines(path, [{'a': 1}])\n"
    assert subprocess.run(command, capture_output=True, check=True).stdout == b"False\n"
    assert path.read_bytes() == b'{"a": 1}\n'


def test_what_is_held_is_so_for_as_long_as_the_context(tmp_path):
    path = tmp_path / "mark"
    with holding(path):
        assert is_held(path)
    assert not is_held(path)
    assert os.listdir(tmp_path) == []


def test_the_commands_run_without_fcntl(tmp_path):
    (tmp_path / "log.csv").write_text("t,y1\n0,1\n0.1,1.1\n0.2,1.2\n")
    short = ["--system", "ReverseDuffing", "--estimator", "open_loop"]
    board = ["leaderboard", "--systems", "ReverseDuffing", "--estimators", "open_loop"]
    board += ["--episodes", "2", "--out", "board", "--jobs"]
    commands = [
        ["systems"],
        ["evaluate", *short, "--episodes", "2", "--out", "evaluated"],
        ["estimate", *short, "--log", "log.csv"],
        [*board, "1"],
    ]
    program = WITHOUT_FCNTL + "from pinnobs_gym import cli\n"
    program += f"for command in {commands!r}:\n    assert cli.main(command) == 0, command\n"
    command = [sys.executable, "-W", "ignore", "-c", program]
    environment = os.environ | {"PYTHONIOENCODING": "cp1252"}  # as Windows writes into a file
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, errors="replace"
    )
    assert done.returncode == 0, done.stderr
    assert "ReverseDuffing" in done.stdout
    assert len((tmp_path / "evaluated" / "rows.jsonl").read_text().splitlines()) == 2
    assert len((tmp_path / "board" / "rows.jsonl").read_text().splitlines()) == 2
    assert len((tmp_path / "estimates.csv").read_text().splitlines()) == 4
    assert not list((tmp_path / "board").glob(".*"))  # neither locks nor marks are left
