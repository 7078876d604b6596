"""Whole files and folders, or none."""

import os
import stat
from pathlib import Path

import pytest
from damage import full_disk, is_one_line_about

from pinnobs_gym.files import CannotWrite, check_writable, replacing, replacing_folder

FULL = Path("/dev/full")
"""A device on which every write finds a full disk."""


def test_replacing_leaves_the_old_file_after_an_error(tmp_path):
    path = tmp_path / "deep" / "file"
    with replacing(path) as temporary:
        temporary.write_text("old")
        assert not path.exists()
    assert path.read_text() == "old"
    with pytest.raises(FileNotFoundError), replacing(path) as temporary:
        temporary.write_bytes(path.with_name("none").read_bytes())
    assert path.read_text() == "old"
    assert os.listdir(path.parent) == ["file"]


def test_where_nothing_can_be_put_replacing_says_so_in_one_line(tmp_path):
    (tmp_path / "folder").mkdir()
    with (
        pytest.raises(ValueError, match=r"cannot write .*folder"),
        replacing(tmp_path / "folder") as temporary,
    ):
        temporary.write_text("a file cannot take a folder's place")
    assert os.listdir(tmp_path) == ["folder"]
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="cannot write"), replacing(tmp_path / "file" / "in it"):
        pass


def test_a_full_disk_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_text("old")
    with full_disk(1000), pytest.raises(CannotWrite) as caught, replacing(path) as temporary:
        temporary.write_bytes(bytes(5000))
    assert is_one_line_about(caught.value, path)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.skipif(not FULL.exists(), reason="this system has no such device")
def test_a_device_is_written_to_and_not_replaced(tmp_path):
    link = tmp_path / "link"
    link.symlink_to(FULL)
    for path in (FULL, link):
        with pytest.raises(CannotWrite, match="No space left on device"), replacing(path) as file:
            file.write_text("text")
    assert stat.S_ISCHR(FULL.stat().st_mode)
    assert link.is_symlink()


def test_a_link_under_the_temporary_name_is_not_followed(tmp_path, monkeypatch):
    """Even if somebody could tell the name."""
    monkeypatch.setattr("secrets.token_hex", lambda count: "known")
    victim, path = tmp_path / "victim", tmp_path / "folder" / "file"
    victim.write_text("mine")
    path.parent.mkdir()
    (path.parent / ".file.known").symlink_to(victim)
    (path.parent / ".probe.known").symlink_to(victim)
    with pytest.raises(CannotWrite, match="File exists"), replacing(path) as temporary:
        temporary.write_text("theirs")
    with pytest.raises(CannotWrite, match="File exists"), replacing_folder(path) as temporary:
        (temporary / "a").write_text("theirs")
    with pytest.raises(CannotWrite, match="File exists"):
        check_writable(path.parent)
    assert victim.read_text() == "mine"


def test_temporary_names_differ_and_are_not_told_by_process_or_time(tmp_path):
    names = []
    for _ in range(2):
        with replacing(tmp_path / "file") as temporary:
            names.append(temporary.name)
            assert temporary.parent == tmp_path
    first, second = (name.rpartition(".")[2] for name in names)
    assert first != second
    assert len(first) == len(second) == 32


@pytest.mark.skipif(os.name != "posix", reason="files have no such permissions")
@pytest.mark.parametrize("mask", [0o022, 0o077, 0o002])
def test_new_files_have_the_permissions_that_the_umask_leaves(tmp_path, mask):
    before = os.umask(mask)
    try:
        with replacing(tmp_path / "file") as temporary:
            temporary.write_text("text")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o666 & ~mask


def test_what_is_durable_is_on_the_disk_before_it_has_its_name(tmp_path, monkeypatch):
    done = []
    move = os.replace

    def sync(number):
        done.append(
            "folder" if stat.S_ISDIR(os.fstat(number).st_mode) else os.fstat(number).st_size
        )

    def replace(source, target):
        done.append("renamed")
        move(source, target)

    monkeypatch.setattr("os.fsync", sync)
    monkeypatch.setattr("os.replace", replace)
    with replacing(tmp_path / "file", durable=True) as temporary:
        temporary.write_text("four")
    assert done == [4, "renamed", *(["folder"] if os.name == "posix" else [])]


def test_a_disk_that_loses_what_it_took_is_an_error(tmp_path, monkeypatch):
    """As a network file system does, which finds out late that there is no room."""

    def sync(number):
        raise OSError(28, "No space left on device")

    path = tmp_path / "file"
    path.write_text("old")
    monkeypatch.setattr("os.fsync", sync)
    with pytest.raises(CannotWrite, match="No space"), replacing(path, durable=True) as temporary:
        temporary.write_text("new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["file"]


def test_a_folder_is_there_whole_or_not_at_all(tmp_path):
    path = tmp_path / "deep" / "folder"
    with replacing_folder(path) as temporary:
        (temporary / "a").write_text("1")
        assert not path.exists()
    assert os.listdir(path) == ["a"]
    with pytest.raises(CannotWrite, match=r"cannot write .*folder: "), replacing_folder(path):
        pass  # in place of a folder that is not empty
    other = path.with_name("other")
    with full_disk(100), pytest.raises(CannotWrite, match="other"), replacing_folder(other) as made:
        (made / "a").write_bytes(bytes(5000))
    with pytest.raises(ZeroDivisionError), replacing_folder(other):
        raise ZeroDivisionError
    assert os.listdir(path.parent) == ["folder"]


def test_an_error_of_a_file_that_is_read_meanwhile_is_no_error_of_writing(tmp_path):
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "file"):
        (tmp_path / "none").read_text()
    assert os.listdir(tmp_path) == []
