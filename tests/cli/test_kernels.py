"""`pinnobs kernels`, and what the page of a system says of compiled code."""

import pytest
from fake_compilers import SOURCE, needs_compiler

from pinnobs_gym.cli import main
from pinnobs_gym.cli.told_section import compiled
from pinnobs_gym.simulation.kernels import cache_folder
from pinnobs_gym.simulation.kernels.build import library
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("PINNOBS_CACHE", str(tmp_path))
    monkeypatch.setattr(cache_folder, "_chosen", {})
    return cache_folder.kernel_folder()


def run(*arguments):
    return main(["kernels", *arguments])


def test_an_empty_folder_is_told(folder, capsys):
    assert run() == 0
    assert f"libraries: 0, 0.0 MB, in {folder}" in capsys.readouterr().out


@needs_compiler
def test_what_is_kept_is_listed_and_cleared(folder, capsys):
    library(SOURCE, {"plant": "Some[Plant]", "template": "ekf"})
    assert run() == 0
    printed = capsys.readouterr().out
    assert "Some[Plant]" in printed
    assert "libraries: 1, 0.0 MB" in printed
    assert "compiler: " in printed
    assert "processor: " in printed
    assert run("--clear") == 0
    assert capsys.readouterr().out == f"1 library removed from {folder}\n"
    assert not list(folder.iterdir())


def test_an_unknown_option_is_refused(folder, capsys):
    assert run("--all") == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


EKFS = "`ekf`, `robust_ekf`, `strong_tracking_ekf`"


@needs_compiler
def test_the_page_of_a_system_says_what_is_compiled():
    assert f"{EKFS}: compiled" in compiled(ReverseDuffing())
    stiff = type("Stiff", (ReverseDuffing,), {"stiff": True})
    assert f"{EKFS}: computed in NumPy: it is stiff" in compiled(stiff())


def test_without_a_compiler_the_page_says_so(monkeypatch):
    monkeypatch.delenv("PINNOBS_KERNELS", raising=False)
    monkeypatch.setattr("pinnobs_gym.simulation.kernels.plant_library.usable_compilers", lambda: [])
    assert f"{EKFS}: computed in NumPy: there is no C compiler" in compiled(ReverseDuffing())
