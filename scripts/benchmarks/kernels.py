"""Filters in compiled code against the same in NumPy, and against JAX's, on the built-in systems.

Times are of one thread, in CPU time, of whole calls of ``run``. Compilation is told apart.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import numpy as np

from benchmarks import Figure, at_least, at_most, cpu_seconds
from benchmarks.classical import played
from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.ukf import UKF
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS

SHAPES = ((1, 1001), (16, 400), (256, 200), (4096, 40))
"""Numbers of episodes and of samples."""
ASKED = {1: 150.0, 256: 10.0}
"""NumPy's time over ours, by the number of episodes."""
ASKED_OF_JAX = {1: 5.0, 256: 8.0}
ASKED_OF_MOTOR = {1: 5.0, 256: 5.0}
"""The same of dynamax."""
T = TypeVar("T", bound=RecursiveEstimator)

PLAYED = 64
"""Number of different episodes; a larger batch repeats them."""
_COMPILATION = """
import json, resource, sys
from pathlib import Path
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.systems import SYSTEMS
assert EKF(SYSTEMS.resolve(sys.argv[1])()).compiled is not None
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps(used.ru_utime + used.ru_stime))
"""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure compiled filters."""
    yield from compilation()
    for name in SYSTEMS.classes():
        for cls in (EKF, UKF):
            if cls.template:
                yield from against_numpy(name, cls, repeats)
                yield update(name, cls, repeats)
        if find_spec("dynamax"):
            yield from against_dynamax(name, repeats)


def compilation() -> Iterator[Figure]:
    """Measure the compiler's time for the EKF of each system, and what is kept of it."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder, "PINNOBS_CACHE": folder}
        environment |= {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        for name in SYSTEMS.classes():
            command = [sys.executable, "-c", _COMPILATION, name]
            done = subprocess.run(command, env=environment, check=True, capture_output=True)
            asked = 1.0 if name == "InductionMotor" else 0.7
            yield at_most(f"compilation, EKF, {name}", json.loads(done.stdout), "CPU-s", asked)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    yield Figure("libraries of the EKF of all systems", size / 1024, "KiB", "", None)


def repeated(name: str, batch: int, samples: int) -> Record:
    """Return the first samples of a batch of benchmark episodes."""
    _, _, record = played(name, min(batch, PLAYED))
    record = record.rows(np.arange(batch) % PLAYED)
    n = min(samples, record.num_samples)
    return replace(record, t=record.t[:n], y=record.y[:, :n].copy(), u=record.u[:, :n].copy())


def pair(name: str, cls: type[T]) -> list[T]:
    """Return an estimator in NumPy, and the same in compiled code."""
    made = []
    for kernels in ("0", "1"):
        with environment(PINNOBS_KERNELS=kernels):
            made.append(cls(SYSTEMS.resolve(name)()))
            assert (made[-1].compiled is None) == (kernels == "0"), name
    return made


@contextmanager
def environment(**values: str) -> Iterator[None]:
    """Set environment variables for a while."""
    before = dict(os.environ)
    os.environ.update(values)
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def medians(calls: list[Callable[[], object]], repeats: int) -> np.ndarray:
    """Return the times of some calls in s, measured alternately, each a few times at once."""
    for call in calls:
        call()  # the first calls fill caches
    times = [cpu_seconds(call) for call in calls]
    counts = [max(1, int(0.02 / max(t, 1e-6))) for t in times]

    def many(call: Callable[[], object], count: int) -> float:
        return cpu_seconds(lambda: [call() for _ in range(count)]) / count

    measured = [
        [many(call, count) for call, count in zip(calls, counts, strict=True)]
        for _ in range(repeats)
    ]
    return np.median(measured, axis=0)


def against_numpy(name: str, cls: type[RecursiveEstimator], repeats: int) -> Iterator[Figure]:
    """Compare compiled code with NumPy."""
    slow, fast = pair(name, cls)
    for batch, samples in SHAPES:
        record = repeated(name, batch, samples)
        times = medians([lambda r=record: slow.run(r), lambda r=record: fast.run(r)], repeats)
        yield from compared("NumPy", f"{fast.label}, {name}", record, times, ASKED.get(batch))


def compared(
    peer: str, what: str, record: Record, times: np.ndarray, asked: float | None
) -> Iterator[Figure]:
    """Return the figures of a peer's time and ours, in s."""
    each = times / (record.batch * record.num_samples) * 1e9
    what = f"{what}, {record.batch} episodes"
    yield Figure(f"{what}: {peer}, per step and episode", float(each[0]), "ns", "", None)
    yield Figure(f"{what}: compiled, per step and episode", float(each[1]), "ns", "", None)
    yield at_least(f"{what}: {peer} / compiled", float(each[0] / each[1]), "x", asked)


def update(name: str, cls: type[RecursiveEstimator], repeats: int) -> Figure:
    """Measure single updates of one episode."""
    record, fast = repeated(name, 1, 201), pair(name, cls)[1]

    def play() -> None:
        state = fast.reset(record.prior)
        for k, t in enumerate(record.t.tolist()):
            state = fast.update(state, t, record.y[:, k], record.u[:, k])

    seconds = medians([play, lambda: fast.reset(record.prior)], repeats)
    value = float(seconds[0] - seconds[1]) / record.num_samples * 1e6
    return at_most(f"{fast.label}, {name}: one update", value, "us", 8.0)


def against_dynamax(name: str, repeats: int) -> Iterator[Figure]:
    """Compare the EKF with dynamax's, with the same model and Runge-Kutta steps."""
    from jax_peers import dynamax_ekf

    fast = pair(name, EKF)[1]
    asked = ASKED_OF_MOTOR if name == "InductionMotor" else ASKED_OF_JAX
    for batch, samples in SHAPES[:3]:
        record = repeated(name, batch, samples)
        peer = dynamax_ekf(fast, record)
        started = cpu_seconds(peer)
        if batch == 1:
            yield Figure(f"dynamax's EKF, {name}: compilation", started, "CPU-s", "", None)
            exact = replace(fast, assumed_noise=0.0)
            difference = dynamax_ekf(exact, record)() - exact.run(record).xhat
            worst = float(abs(difference / np.asarray(fast.system.scale)).max())
            yield at_most(f"EKF - dynamax's over scale, {name}", worst, "", 1e-4)
        times = medians([peer, lambda r=record: fast.run(r)], repeats)
        yield from compared("dynamax", f"ekf, {name}", record, times, asked.get(batch))
