"""Consoles of few characters, pipes whose reader has left, deleted folders."""

import io
import os
import sys
from contextlib import contextmanager, redirect_stdout

import pytest
import torch

from pinnobs_gym.cli import guarded, main
from pinnobs_gym.cli.console import console


@contextmanager
def left():
    """Have standard output be a pipe whose reader has left."""
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w", encoding="utf-8") as stream, redirect_stdout(stream):
        yield
        stream.flush()  # as Python does at the end of the process: without an error


def printed():
    for _ in range(1000):
        console.print("row " * 20)
    return 0


@pytest.mark.parametrize(
    "command",
    [
        lambda: main(["--help"]),
        lambda: main(["tables", "--help"]),
        lambda: main(["systems"]),
        lambda: guarded(printed),
    ],
)
def test_a_pipe_whose_reader_has_left_ends_the_command_without_a_word(capsys, command):
    with left():
        assert command() == 141
    assert not capsys.readouterr().err


def test_a_connection_that_breaks_is_told(capsys):
    def lost():
        raise BrokenPipeError("connection to worker 3 is lost")

    assert guarded(lost) == 1
    assert capsys.readouterr().err == "pinnobs: error: connection to worker 3 is lost\n"


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
@pytest.mark.parametrize(
    ("arguments", "status", "shown"),
    [
        (["estimators", "ekf"], 0, "Joseph's form"),
        (["evaluate", "--system", "Σ"], 2, "unknown system '?'"),
        (["leaderboard", "--suite", "a\u2212b"], 2, "unknown suite 'a?b'"),
        (["estimate", "--help"], 0, "--log"),
    ],
)
def test_a_console_of_few_characters_shows_all_others(
    monkeypatch, encoding, arguments, status, shown
):
    streams = [io.TextIOWrapper(io.BytesIO(), encoding=encoding) for _ in range(2)]
    monkeypatch.setattr(sys, "stdout", streams[0])
    monkeypatch.setattr(sys, "stderr", streams[1])
    assert main(arguments) == status
    streams[status == 2].flush()
    assert shown in streams[status == 2].buffer.getvalue().decode(encoding)


def test_a_deleted_working_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "path", list(sys.path))
    folder = tmp_path / "gone"
    folder.mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    assert main(["systems"]) == 0
    assert main(["leaderboard", "--suite", "quick", "--out", "o"]) == 2
    assert "working folder has been deleted" in capsys.readouterr().err


def test_messages_of_any_length_are_one_short_line(capsys):
    def failed():
        raise ValueError("a\n" * 10**5)

    assert guarded(failed) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert len(message) < 2000


class Unreadable(BaseException):
    """An error that only a plug-in could raise."""

    def __str__(self):
        raise SystemExit(3)


def test_an_error_that_cannot_be_read_is_one_line(capsys):
    def failed():
        raise Unreadable

    assert guarded(failed) == 1
    line = "pinnobs: error: Unreadable: an error without a readable text"
    assert capsys.readouterr().err.startswith(line)


def test_too_little_memory_is_told(capsys):
    def failed():
        raise MemoryError("Unable to allocate 364. TiB")

    assert guarded(failed) == 2
    assert "not enough memory: Unable to allocate 364. TiB" in capsys.readouterr().err

    def of_torch():
        torch.empty(2**50)

    assert guarded(of_torch) == 2
    assert "not enough memory: [enforce fail" in capsys.readouterr().err
