"""What a command imports: libraries that take long to load are loaded where they are used."""

import subprocess
import sys

import pytest

SLOW = ("torch", "scipy.stats", "matplotlib", "sympy", "stable_baselines3", "tensorboard", "rich")
RUN = """
import sys
from pinnobs_gym.cli import main
assert main(sys.argv[1:]) == 0
print("loaded:", *sys.modules, file=sys.stderr)
"""
EVALUATE = ("evaluate", "--system", "ReverseDuffing", "--episodes", "1", "--estimator")
COMPATIBLE = "array_api_compat.numpy"
"""A copy of all of NumPy's modules."""


def loaded(folder, *arguments):
    call = [sys.executable, "-c", RUN, *arguments]
    done = subprocess.run(call, cwd=folder, capture_output=True, text=True, check=True)
    return set(done.stderr.rpartition("loaded:")[2].split())


def test_help_loads_nothing_slow(tmp_path):
    assert loaded(tmp_path, "--help").isdisjoint({*SLOW, "scipy"})


@pytest.mark.parametrize("estimator", ["ekf", "ukf"])
def test_a_filter_with_written_jacobians_needs_no_network_no_symbols_and_no_tests(
    tmp_path, estimator
):
    # The first may compile the filter, of symbols. It is a process of its own: one that has loaded
    # the filter's code before would not see that the file of it is gone.
    loaded(tmp_path, *EVALUATE, estimator)
    found = loaded(tmp_path, *EVALUATE, estimator, "--fresh")
    assert found.isdisjoint({*SLOW, COMPATIBLE} - {"tensorboard", "rich"})
    assert f"pinnobs_gym.estimators.{estimator}" in found
    others = {name for name in found if name.startswith("pinnobs_gym.estimators.")}
    assert others == {f"pinnobs_gym.estimators.{estimator}"}


def test_a_picture_is_drawn_of_several_episodes_unless_their_scores_are_stored(tmp_path):
    several = (*(part.replace("1", "2") for part in EVALUATE), "ekf")
    assert "matplotlib" in loaded(tmp_path, *several, "--fresh")
    assert "matplotlib" not in loaded(tmp_path, *several)
