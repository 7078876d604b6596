"""Compilation: which compiler, and what happens where one fails."""

import ctypes
import os
import signal
import subprocess
import time

import pytest
from fake_compilers import (
    COMPILES,
    FAILS,
    GARBAGE,
    SOURCE,
    calls,
    fake,
    in_process,
    needs_compiler,
    output_of,
    posix,
)

from pinnobs_gym.simulation.kernels import build, compilers
from pinnobs_gym.simulation.kernels.build import library

pytestmark = posix

MAKES = f"""
from pinnobs_gym.simulation.kernels.build import library
made = library({SOURCE!r})
print(made if isinstance(made, str) else "made")
"""


def answer(made):
    function = made[0].answer
    function.restype = ctypes.c_double
    return function()


def said(caplog):
    return [record.getMessage() for record in caplog.records]


def test_compilers_are_tried_in_order(alone, monkeypatch):
    for name in ("gcc", "clang", "cc", "own"):
        fake(alone, name, "exit 1")
    monkeypatch.setenv("CC", "own -m64")
    found = compilers.compilers()
    assert [compiler.name for compiler in found] == ["own -m64", "cc", "clang", "gcc"]
    assert found[0].command[1:] == ("-m64",)


def test_one_compiler_under_two_names_is_tried_once(alone):
    fake(alone, "gcc", "exit 1")
    (alone / "cc").symlink_to(alone / "gcc")
    assert [compiler.name for compiler in compilers.compilers()] == ["cc"]


def test_a_chosen_compiler_that_is_not_there_is_named(alone, fresh, monkeypatch, caplog):
    monkeypatch.setenv("CC", "none_of_this_name")
    assert compilers.compilers() == []
    assert said(caplog) == [
        "CC=none_of_this_name is not found; the usual names of C compilers are tried"
    ]


def test_a_compiler_that_fails_is_named_once_and_not_tried_again(own_folder, alone, caplog):
    compiler = fake(alone, "cc", FAILS)
    reason = library(SOURCE)
    assert reason == (
        "the C compiler cc failed with status 1: kernel.c:1:10: fatal error: math.h: No such file"
    )
    assert library(SOURCE + "/* another */") == "no C compiler works"
    assert calls(compiler) == 1
    assert said(caplog) == [f"{reason}; NumPy is used"]


def test_without_a_compiler_there_is_a_reason(own_folder, alone):
    assert library(SOURCE) == "there is no C compiler"


@needs_compiler
def test_the_next_compiler_is_tried(own_folder, alone, monkeypatch, caplog):
    fake(alone, "cc", FAILS)
    fake(alone, "clang", COMPILES)
    monkeypatch.setenv("PATH", f"{alone}{os.pathsep}{os.defpath}")  # what the real one calls
    assert answer(library(SOURCE)) == 42
    assert said(caplog)[0].endswith("; clang is tried")


@needs_compiler
def test_a_compiler_that_made_a_library_is_not_given_up(own_folder, monkeypatch):
    good = library(SOURCE)
    assert answer(good) == 42
    assert "error" in library("this is no C")
    assert answer(library(SOURCE + "/* another */")) == 42


def test_a_compiler_that_hangs_is_stopped_with_its_children(own_folder, alone, monkeypatch):
    monkeypatch.setattr(build, "PATIENCE", 1.0)
    beats = alone / "beats"
    loop = f"while :; do echo x >> {beats}; /bin/sleep 0.05; done"
    fake(alone, "cc", f"({loop}) &\nwait")
    assert library(SOURCE) == "the C compiler cc did not end within 1 s"
    size = beats.stat().st_size
    time.sleep(0.3)
    assert beats.stat().st_size == size > 0


@pytest.mark.parametrize(
    ("does", "reason"),
    [
        (GARBAGE, "the library that cc made cannot be called: the call failed with status 1: OSEr"),
        ("exit 0", "the C compiler cc wrote no library"),
        ("kill -9 $$", "the C compiler cc was ended by signal 9"),
        ('printf "\\377 error \\000" >&2; exit 3', "the C compiler cc failed with status 3: "),
    ],
)
def test_what_a_broken_compiler_makes_is_not_kept(own_folder, alone, does, reason):
    fake(alone, "cc", does)
    assert library(SOURCE).startswith(reason)
    assert not list(own_folder.glob("*.so"))
    assert not list(own_folder.glob("work-*"))


@needs_compiler
def test_a_library_that_crashes_is_called_in_another_process(own_folder):
    crash = "void evaluate(void) { *(volatile int *)0 = 1; }\n"
    assert "cannot be called: the call was ended by signal 11" in library(crash)
    assert not list(own_folder.glob("*.so"))


def test_a_failure_is_remembered_by_other_processes_for_some_time(own_folder, alone, monkeypatch):
    compiler = fake(alone, "cc", FAILS)
    first = library(SOURCE)
    monkeypatch.setattr(build, "_broken", set())  # as in another process
    assert library(SOURCE) == first
    assert calls(compiler) == 1
    monkeypatch.setattr(build, "_broken", set())
    now = time.time()
    monkeypatch.setattr(time, "time", lambda: now + build.REMEMBERED + 1)
    library(SOURCE)
    assert calls(compiler) == 2


@needs_compiler
def test_of_two_processes_at_once_one_compiles(own_folder, tmp_path):
    compiler = fake(tmp_path / "bin", "slow", f"sleep 1\n{COMPILES}")
    started = [in_process(MAKES, CC=str(compiler)) for _ in range(2)]
    assert [output_of(process) for process in started] == ["made", "made"]
    assert calls(compiler) == 1


@needs_compiler
def test_a_killed_process_does_not_keep_others_waiting(own_folder, tmp_path, monkeypatch):
    pid, folder = tmp_path / "pid", tmp_path / "bin"
    stuck = f"if [ ! -e {pid} ]; then echo $$ > {pid}.new; mv {pid}.new {pid}; sleep 60; fi"
    compiler = fake(folder, "stuck", f"{stuck}\n{COMPILES}")
    killed = in_process(MAKES, CC=str(compiler))
    while not pid.exists():
        assert killed.poll() is None
        time.sleep(0.02)
    killed.kill()
    killed.communicate()
    monkeypatch.setenv("CC", str(compiler))
    assert answer(library(SOURCE)) == 42
    os.killpg(int(pid.read_text()), signal.SIGKILL)
    assert len(list(own_folder.glob("work-*"))) == 1  # young, so that it may be in use


@needs_compiler
def test_another_processor_compiler_or_flag_is_another_library(own_folder, monkeypatch, tmp_path):
    names = {library(SOURCE)[1]}
    for name, value in (("processor", "another"), ("flags", compilers.flags()[1:])):
        with monkeypatch.context() as patch:
            patch.setattr(compilers, name, lambda value=value: value)
            names.add(library(SOURCE)[1])
    compiler = fake(tmp_path / "bin", "own", COMPILES)
    monkeypatch.setenv("CC", str(compiler))
    names.add(library(SOURCE)[1])
    compiler.write_text(f"{compiler.read_text()}\n\n")
    names.add(library(SOURCE)[1])
    assert len(names) == 5


@needs_compiler
def test_code_for_this_very_processor_needs_its_name(monkeypatch):
    compilers.flags.cache_clear()
    monkeypatch.setattr(compilers, "processor", lambda: "")
    try:
        assert not [flag for flag in compilers.flags() if "native" in flag]
    finally:
        compilers.flags.cache_clear()


@needs_compiler
def test_a_library_that_is_not_whole_is_made_again(own_folder):
    assert output_of(in_process(MAKES)) == "made"  # not here, where it would stay loaded
    (path,) = own_folder.glob("*.so")
    path.write_bytes(path.read_bytes()[:100])
    home = "pinnobs_gym.simulation.kernels.build"
    code = f"import sys; from {home} import kept; print(kept(sys.argv[1]))"
    assert output_of(in_process(code, path.stem)) == "None"
    assert output_of(in_process(MAKES)) == "made"
    assert path.stat().st_size > 100


def test_zig_is_a_compiler_where_its_wheel_is_installed(monkeypatch):
    monkeypatch.setattr(compilers.importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(compilers, "version", lambda name: "0.13")
    found = compilers.compilers()[-1]
    assert found.command[1:] == ("-m", "ziglang", "cc")
    assert "0.13" in found.identity


def test_no_process_is_left(own_folder, alone, monkeypatch):
    """An interrupt, such as Ctrl-C, ends the compiler too."""
    pid = alone / "pid"
    fake(alone, "cc", f"echo $$ > {pid}\n/bin/sleep 60")

    def interrupt(self, timeout=None):
        while not (pid.exists() and pid.read_text()):
            time.sleep(0.02)
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess.Popen, "wait", interrupt)
    with pytest.raises(KeyboardInterrupt):
        library(SOURCE)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)
