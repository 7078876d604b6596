"""Times of calls measured alternately, and measurements in processes of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from benchmarks import cpu_seconds
from benchmarks.classical import played

from pinnobs_gym.estimation.recursive import RecursiveEstimator
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.systems import SYSTEMS

T = TypeVar("T", bound=RecursiveEstimator)

PLAYED = 64
"""Number of different episodes; a larger batch repeats them."""


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


def medians(calls: Sequence[Callable[[], object]], repeats: int) -> np.ndarray:
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


def in_process(module: str, *arguments: object, **values: str) -> Any:
    """Return what a module of this folder prints as JSON in a process of its own, with environment
    variables set."""
    command = [sys.executable, "-m", f"kernel_figures.{module}", *map(str, arguments)]
    path = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path} | values, stdout=subprocess.PIPE, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])
