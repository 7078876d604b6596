"""Devices, from which more than the memory holds could be read."""

import os
from pathlib import Path

import pytest

from pinnobs_gym.leaderboard import suites
from pinnobs_gym.logs.table import read_table
from pinnobs_gym.scoring import rows

ZEROS = Path("/dev/zero")


@pytest.mark.skipif(not ZEROS.is_char_device(), reason="no such device")
@pytest.mark.parametrize("read", [rows.load, lambda path: suites.load(str(path)), read_table])
def test_a_device_is_refused_before_it_is_read(read, tmp_path):
    path = tmp_path / "endless.toml"
    path.symlink_to(ZEROS)
    with pytest.raises(ValueError, match=r"^cannot read .*endless.toml: it is a device; expected"):
        read(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no such pipes")
def test_a_pipe_is_read(tmp_path):
    reader, writer = os.pipe()
    os.close(writer)
    try:
        assert rows.load(Path(f"/dev/fd/{reader}")).rows == []
    finally:
        os.close(reader)
