"""What a user waits for: the start of commands; and the memory of envs."""

from __future__ import annotations

import gc
import resource
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import gymnasium as gym
import numpy as np

from benchmarks import Figure, at_most
from pinnobs_gym.envs.registration import env_id

EVALUATE = ("evaluate", "--system", "ReverseDuffing", "--estimator", "ekf", "--episodes", "1")
ENVS = 1000
"""Number of envs whose memory is told."""
MEASURED = 20
"""Number of those that are made."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure commands, then envs."""
    yield at_most("pinnobs --help", seconds(repeats, "--help"), "CPU s", 0.4)
    with tempfile.TemporaryDirectory() as folder:
        fresh = (*EVALUATE, "--fresh", "--out", str(Path(folder) / "out"))
        yield at_most("pinnobs evaluate, one episode", seconds(repeats, *fresh), "CPU s", 1.0)
    what = f"arrays of {ENVS} single envs of ReverseDuffing after an episode"
    yield at_most(what, megabytes("ReverseDuffing"), "MB", 300.0)


def seconds(repeats: int, *arguments: str) -> float:
    """Return the median CPU time of a command in s, after one that fills caches."""

    def spent() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        call = [sys.executable, "-m", "pinnobs_gym.cli", *arguments]
        subprocess.run(call, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime

    spent()
    return float(np.median([spent() for _ in range(repeats)]))


def megabytes(name: str) -> float:
    """Return what envs hold in MB when their second episode begins."""
    gym.make(env_id(name)).reset(seed=0)  # what is kept once for all envs
    tracemalloc.start()
    try:
        envs = [gym.make(env_id(name)) for _ in range(MEASURED)]
        for seed, env in enumerate(envs):
            env.reset(seed=seed)
            env.reset()
        gc.collect()
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return held / MEASURED * ENVS / 1e6
