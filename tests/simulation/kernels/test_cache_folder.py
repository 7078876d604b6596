"""The folder of compiled code: where it is, when it is trusted, and what it keeps."""

import os
import stat
import time
from pathlib import Path

import pytest
from fake_compilers import REAL, SOURCE, needs_compiler

from pinnobs_gym.simulation.kernels import cache_folder
from pinnobs_gym.simulation.kernels.build import kept, library
from pinnobs_gym.simulation.kernels.cache_folder import (
    clear,
    kept_libraries,
    kernel_folder,
    read_json,
    trim,
    write_json,
)

posix = pytest.mark.skipif(os.name == "nt", reason="owners and modes of POSIX")


@pytest.mark.parametrize(
    ("platform", "environment", "expected"),
    [
        ("linux", {}, ".cache/pinnobs-gym/kernels"),
        ("linux", {"XDG_CACHE_HOME": "{}/x"}, "x/pinnobs-gym/kernels"),
        ("darwin", {}, "Library/Caches/pinnobs-gym/kernels"),
        ("win32", {"LOCALAPPDATA": "{}/Local"}, "Local/pinnobs-gym/kernels"),
        ("linux", {"XDG_CACHE_HOME": "{}/x", "PINNOBS_CACHE": "{}/own"}, "own/kernels"),
    ],
)
def test_where_it_is(fresh, monkeypatch, tmp_path, platform, environment, expected):
    monkeypatch.setattr(cache_folder.sys, "platform", platform)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    for name in ("XDG_CACHE_HOME", "LOCALAPPDATA", "PINNOBS_CACHE"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value.format(tmp_path))
    assert kernel_folder() == tmp_path / expected


@posix
def test_it_is_closed_to_others(own_folder):
    assert stat.S_IMODE(own_folder.stat().st_mode) == 0o700


def nobody(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)


@posix
@pytest.mark.parametrize("what", ["link", "mode", "owner"])
def test_a_folder_of_others_is_not_used(fresh, tmp_path, monkeypatch, caplog, what):
    folder = tmp_path / "kernels"
    monkeypatch.setenv("PINNOBS_CACHE", str(tmp_path))
    if what == "link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.mkdir(mode=0o700)
    if what == "mode":
        folder.chmod(0o770)
    if what == "owner":
        nobody(monkeypatch)
    reason = {
        "link": f"{folder} is a link",
        "mode": f"others can write to {folder}",
        "owner": f"{folder} belongs to another user",
    }[what]
    found = kernel_folder()
    assert found != folder
    assert kernel_folder() == found
    assert [record.getMessage() for record in caplog.records] == [
        f"compiled code is kept for this process only: {reason}"
    ]


def no_home():
    raise RuntimeError("Could not determine home directory.")


def test_without_a_folder_a_temporary_one_is_used(fresh, tmp_path, monkeypatch, caplog):
    (tmp_path / "file").touch()
    monkeypatch.setenv("PINNOBS_CACHE", str(tmp_path / "file" / "x"))
    first = kernel_folder()
    monkeypatch.delenv("PINNOBS_CACHE")
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    second = kernel_folder()
    assert first.is_dir()
    assert second.is_dir()
    assert len(caplog.records) == 2
    if REAL:
        assert kept(library(SOURCE)[1]) is not None


@posix
@pytest.mark.skipif(os.name != "nt" and os.geteuid() == 0, reason="root can write everywhere")
def test_a_folder_that_cannot_be_written_to(fresh, tmp_path, monkeypatch, caplog):
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels").chmod(0o500)
    monkeypatch.setenv("PINNOBS_CACHE", str(tmp_path))
    assert kernel_folder() != tmp_path / "kernels"
    assert "cannot be written to: Permission denied" in caplog.text


@posix
@needs_compiler
@pytest.mark.parametrize("what", ["link", "mode"])
def test_a_library_of_others_is_not_loaded(own_folder, tmp_path, caplog, what):
    name = library(SOURCE)[1]
    path = own_folder / f"{name}.so"
    if what == "mode":
        path.chmod(0o666)
    else:
        path.rename(tmp_path / "other.so")
        path.symlink_to(tmp_path / "other.so")
    assert kept(name) is None
    assert not isinstance(library(SOURCE), str)
    assert kernel_folder() != own_folder
    (line,) = [record.getMessage() for record in caplog.records]
    assert line.startswith("compiled code is kept for this process only: ")
    assert line.endswith("; remove it")


@posix
def test_an_entry_of_others_is_not_read(own_folder, monkeypatch):
    path = own_folder / f"{'0' * 24}.plant"
    write_json(path, {"library": "a"})
    assert read_json(path) == {"library": "a"}
    path.chmod(0o646)
    assert read_json(path) is None
    path.chmod(0o600)
    path.write_text('{"library":')
    assert read_json(path) is None


def put(folder, number, age, size=10):
    """Write a library with what belongs to it, used some time ago."""
    stem = f"{number:024x}"
    for suffix in (".so", ".json"):
        path = folder / f"{stem}{suffix}"
        path.write_bytes(b"0" * size if suffix == ".so" else b'{"plant": "P"}')
        path.chmod(0o600)
        os.utime(path, (time.time() - age,) * 2)
    write_json(folder / f"{number + 1000:024x}.plant", {"library": stem})


def numbers(folder, suffix=".so"):
    return sorted(int(path.stem, 16) for path in folder.glob(f"*{suffix}"))


@pytest.mark.parametrize(("files", "size"), [(3, 10**6), (500, 3 * 10**5)])
def test_the_libraries_used_last_are_kept(own_folder, monkeypatch, files, size):
    monkeypatch.setattr(cache_folder, "MOST_FILES", files)
    monkeypatch.setattr(cache_folder, "MOST_BYTES", size)
    for number in range(5):
        put(own_folder, number, age=100 * number, size=10**5)
    (own_folder / "notes.txt").touch()
    trim(own_folder)
    assert numbers(own_folder) == numbers(own_folder, ".json") == [0, 1, 2]
    assert numbers(own_folder, ".plant") == [1000, 1001, 1002]
    assert (own_folder / "notes.txt").exists()


def test_what_killed_processes_left_is_removed_after_an_hour(own_folder):
    for age in (1800, 5400):
        work = own_folder / f"work-{age}"
        work.mkdir()
        (work / "kernel.c").touch()
        incomplete = own_folder / f"{age:024x}.plant.{'a' * 32}"
        incomplete.touch()
        for path in (work, incomplete):
            os.utime(path, (time.time() - age,) * 2)
    trim(own_folder)
    assert sorted(path.name for path in own_folder.iterdir()) == sorted(
        ["work-1800", f"{1800:024x}.plant.{'a' * 32}"]
    )


def test_only_what_was_written_here_is_cleared(own_folder):
    for number in range(3):
        put(own_folder, number, 0)
    others = {"notes.txt", "libm.so", "work.c", "workplace"}
    for name in others:
        (own_folder / name).touch()
    (own_folder / "0123.so").touch()
    assert [kept.about for kept in kept_libraries(own_folder)] == [{"plant": "P"}] * 3
    assert clear(own_folder) == 3
    assert {path.name for path in own_folder.iterdir()} == others | {"0123.so"}
