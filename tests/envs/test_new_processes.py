"""A system of one's own in worker processes, however these are started."""

import json
import subprocess
import sys

import pytest

from pinnobs_gym.registry import Registry

SYSTEM = '''
from pinnobs_gym import Setup, System, stack


class Osc(System):
    """Oscillator, 1 rad/s."""

    state_names = ("a", "b")
    output_names = ("y",)
    scale = (1.0, 1.0)
    setups = {
        "benchmark": Setup(
            x0_low=(-1, -1),
            x0_high=(1, 1),
            duration=1,
            dt=0.1,
            noise_std=0.1,
        )
    }

    def f(self, t, x, u):
        return stack(x, x[..., 1], -x[..., 0])

    def h(self, t, x, u):
        return x[..., :1]
'''
SCRIPT = '''
import json
import sys
from functools import partial

import gymnasium as gym
import pinnobs_gym
import osc


class Own(osc.Osc):
    """Defined in the script itself."""


def local():
    class Inner(osc.Osc):
        """Defined in a function."""

    return Inner


def asynchronous(name, context):
    kwargs = {"context": context}
    return gym.make_vec(name, 2, vectorization_mode="async", vector_kwargs=kwargs)


def subproc(name, context):
    from stable_baselines3.common.vec_env import SubprocVecEnv

    make = partial(gym.make, gym.spec(name))  # an id is known to the process alone that gave it
    return SubprocVecEnv([make, make], start_method=context)


if __name__ == "__main__":
    kind, context, *systems = sys.argv[1:]
    found = {}
    for system in systems:
        cls = {"Osc": osc.Osc, "Own": Own}.get(system) or local()
        pinnobs_gym.register(cls)
        env = globals()[kind](f"pinnobs/{system}-v0", context)
        if kind == "subproc":
            env.seed(0)
            there = env.reset().tolist()
        else:
            there = env.reset(seed=0)[0].tolist()
        env.close()
        env = gym.make(f"pinnobs/{system}-v0")
        found[system] = there, [env.reset(seed=seed)[0].tolist() for seed in (0, 1)]
    print(json.dumps(found))
'''


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "osc.py").write_text(SYSTEM)
    (tmp_path / "script.py").write_text(SCRIPT)
    return tmp_path


def run(folder, *arguments):
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=500)


def check(found):
    """The first observations of two seeds are those of a single env in the script's process."""
    for there, here in found.values():
        assert there == here
        assert there[0] != there[1]
    assert found["Osc"] != found["Own"]  # seeds are salted with the system's name


@pytest.mark.parametrize("context", ["fork", "spawn", "forkserver"])
def test_own_systems_play_in_gymnasiums_worker_processes(folder, context):
    done = run(folder, "script.py", "asynchronous", context, "Osc", "Own")
    assert done.returncode == 0, done.stderr
    check(json.loads(done.stdout))


@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_own_systems_play_in_stable_baselines_worker_processes(folder, context):
    done = run(folder, "script.py", "subproc", context, "Osc", "Own")
    assert done.returncode == 0, done.stderr
    check(json.loads(done.stdout))


def test_a_class_of_a_function_is_refused_in_one_line_by_a_new_process(folder):
    done = run(folder, "script.py", "asynchronous", "spawn", "Inner")
    assert done.returncode != 0
    told = "ValueError: cannot load system '__main__:local.<locals>.Inner' in a new process, which"
    assert any(line.startswith(told) for line in done.stderr.splitlines()), done.stderr
    assert "AttributeError" not in done.stderr


def test_a_class_of_a_notebook_is_refused_in_one_line():
    systems = Registry("system", "pinnobs_gym.simulation.system:System", "pinnobs_gym.systems")
    with pytest.raises(ValueError, match=r"system '__main__:Cell' in a new process, .*notebook"):
        systems.resolve("__main__:Cell")
    with pytest.raises(ValueError, match="cannot load system 'osc:Osc': ModuleNotFoundError"):
        systems.resolve("osc:Osc")


def test_own_systems_are_played_by_the_processes_of_a_leaderboard(folder):
    command = ["-m", "pinnobs_gym.cli", "leaderboard", "--systems", "osc:Osc", "--episodes", "2"]
    command += ["--estimators", "ekf", "open_loop", "--out", "board", "--jobs", "2"]
    done = run(folder, *command)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = (folder / "board" / "rows.jsonl").read_text().splitlines()
    assert (
        sorted(json.loads(line)["estimator"] for line in lines) == ["ekf"] * 2 + ["open_loop"] * 2
    )
