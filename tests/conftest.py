import atexit
import gc
import itertools
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

# What a terminal or a user's environment would change, before anything reads it.
os.environ["TTY_COMPATIBLE"] = "0"
os.environ.pop("FORCE_COLOR", None)
os.environ.pop("PINNOBS_TRACEBACK", None)
os.environ.pop("PINNOBS_KERNELS", None)
os.environ.pop("CC", None)
if sys.dont_write_bytecode:
    # Else each process of the tests compiles the package anew. Nothing is written beside sources,
    # and nothing is kept for another session, in which folders of tests have the same names.
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = tempfile.mkdtemp("-pinnobs-bytecode")
    atexit.register(shutil.rmtree, sys.pycache_prefix, ignore_errors=True)
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False
# Compiled code is kept for all test processes and for the next run, apart from the user's own.
os.environ["PINNOBS_CACHE"] = str(Path(__file__).parents[1] / ".pytest_cache" / "pinnobs")
if not any(map(shutil.which, ("cc", "clang", "gcc"))):
    os.environ["PINNOBS_KERNELS"] = "0"  # says no line in the log of a test about something else
os.environ.setdefault("OMP_NUM_THREADS", "1")  # as our command does, whichever test calls it first

import gymnasium as gym
import pytest

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.systems import SYSTEMS


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """What is imported and collected stays, and is not searched for garbage time and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def isolated_registries():
    ids = set(gym.registry)
    with SYSTEMS.isolated(), ESTIMATORS.isolated():
        yield
    for name in set(gym.registry) - ids:
        del gym.registry[name]


@pytest.fixture(autouse=True)
def registries_as_they_were():
    """What a test registers is gone after it."""
    yield from isolated_registries()


@pytest.fixture(autouse=True, scope="module")
def registries_of_modules():
    """What a fixture of a module registers is gone after the module."""
    yield from isolated_registries()


@pytest.fixture(scope="session")
def no_results(tmp_path_factory):
    """An empty folder of published results."""
    return tmp_path_factory.mktemp("published")


@pytest.fixture(autouse=True)
def nothing_published(monkeypatch, no_results):
    """What a test finds does not depend on the results that ship with the package."""
    monkeypatch.setattr("pinnobs_gym.leaderboard.published.manifest.FOLDER", no_results)


@pytest.fixture(autouse=True)
def no_power_cuts(monkeypatch):
    """No test waits for the disk: what it writes is gone with it."""
    monkeypatch.setattr("os.fsync", lambda number: None)


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch):
    """What is said once in a process is said once in each test."""
    monkeypatch.setattr("pinnobs_gym.simulation.notices._SUBJECTS", set())


@pytest.fixture
def ticking(monkeypatch):
    """CPU time goes on by 0.01 s whenever it is looked at, on a machine of any speed."""
    ticks = itertools.count()
    monkeypatch.setattr(time, "process_time", lambda: next(ticks) / 100)


@pytest.fixture(scope="module")
def browser():
    """A browser without a screen; tests of pages are left out where there is none."""
    from playwright.sync_api import sync_playwright
    from waiting import PATIENCE

    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("no chromium here")
    switches = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"]
    switches += ["--disable-background-networking", "--disable-component-update"]
    with sync_playwright() as playwright:
        launch = playwright.chromium.launch
        browser = launch(executable_path=chromium, args=switches, timeout=1000 * PATIENCE)
        yield browser
        browser.close()
