import pytest

from pinnobs_gym.simulation.kernels import build, cache_folder
from pinnobs_gym.simulation.notices import say_once


@pytest.fixture
def fresh(monkeypatch):
    """As if the process had just started: nothing is known of compilers and folders."""
    monkeypatch.setattr(build, "_broken", set())
    monkeypatch.setattr(build, "_proven", set())
    monkeypatch.setattr(cache_folder, "_chosen", {})
    say_once.cache_clear()
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.delenv("PINNOBS_KERNELS", raising=False)


@pytest.fixture
def own_folder(tmp_path, monkeypatch, fresh):
    """A folder of compiled code for one test."""
    monkeypatch.setenv("PINNOBS_CACHE", str(tmp_path / "cache"))
    return cache_folder.kernel_folder()


@pytest.fixture
def alone(tmp_path, monkeypatch):
    """A folder of compilers beside which there are none."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr("pinnobs_gym.simulation.kernels.compilers._zig", lambda: None)
    return folder
