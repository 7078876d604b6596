"""PINN-Obs on many records. Lines that name a GPU were measured on its machine, a core of which is
their peer (H200: an Intel Xeon)."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import torch

from benchmarks import Figure, at_least, cpu_seconds, median_ratio
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.training.loop import train
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer, plain
from trainers.pinn_obs.fast_recipe import FastRecipe
from trainers.pinn_obs.objective import Objective

GPU = torch.cuda.is_available()
MANY = 64
"""Number of records of what is measured on the CPU."""
SINGLE = 4
"""Number of records by which the time of a single training is measured."""
ITERATIONS = 300


def figures(repeats: int) -> Iterator[Figure]:
    """Measure PINN-Obs on many records."""
    source = EpisodeSource("ReverseDuffing")
    streams = source.streams(range(1024 if GPU else MANY))
    record = source.record(source.play(source.draw(streams)))
    for many in (64, 256, 1024) if GPU else (MANY,):
        yield from at_once(source, record.rows(slice(many)), repeats)
    record = record.rows(slice(MANY))
    yield guides_at_once(source, record, repeats)
    yield stacked_evaluations(source, record, repeats)


def at_once(source: EpisodeSource, record: Record, repeats: int) -> Iterator[Figure]:
    """Compare the records per second of `train_rows` with those of `train` on one core.

    Only the first iterations of the guided preset are run.
    """
    system, noise, many = source.system, source.setup.noise_std, record.batch
    config = PinnObsConfig(iterations=ITERATIONS)

    def single() -> None:
        for i in range(SINGLE):
            row = record.rows(slice(i, i + 1))
            train(PinnObsTrainer(system, config, record=row, noise_std=noise))

    def together() -> None:
        PinnObsTrainer.train_rows(system, config, record=record, noise_std=noise)

    single()
    if GPU:
        together()  # its first call loads what the GPU runs
    ratios, times = [], []
    for _ in range(repeats):
        one = cpu_seconds(single) / SINGLE
        start = time.perf_counter()  # of a GPU, the CPU's time is not all
        seconds = cpu_seconds(together)
        seconds = time.perf_counter() - start if GPU else seconds
        times.append(seconds / many)
        ratios.append(one / times[-1])
    where = f"on {torch.cuda.get_device_name()}" if GPU else "on the CPU"
    name = f"{many} records by train_rows, {where}"
    asked = 50.0 if GPU and many == 256 else None  # the bound is of a GPU and 256 records
    yield Figure(f"{name}, each", float(np.median(times)) * 1e3, "ms", "", None)
    ratio = float(np.median(ratios))
    yield at_least(f"{name}, over one by train on a core, records per second", ratio, "x", asked)


def guides_at_once(source: EpisodeSource, record: Record, repeats: int) -> Figure:
    """Compare the recipes per CPU-second that are made at once, with their guides, with those made
    one by one."""
    system, noise = source.system, source.system.noise(source.setup.noise_std)
    rows = [record.rows(slice(i, i + 1)) for i in range(MANY)]
    config = PinnObsConfig()
    ratio = median_ratio(
        lambda: [FastRecipe(system, config, row, noise) for row in rows],
        lambda: FastRecipe.many(system, config, rows, noise),
        repeats,
    )
    name = f"{MANY} guides at once / one by one, records per CPU-second, on the CPU"
    return at_least(name, ratio, "x", None)


def stacked_evaluations(source: EpisodeSource, record: Record, repeats: int) -> Figure:
    """Compare the evaluations per CPU-second of stacked objectives with those of single ones.

    Both run on the CPU, where the result is the reason that `train_rows` trains one record after
    another.
    """
    noise = source.setup.noise_std
    rows = [record.rows(slice(i, i + 1)) for i in range(MANY)]
    config = plain()  # the guide is no part of an evaluation
    runs = [PinnObsTrainer(source.system, config, record=r, noise_std=noise) for r in rows]
    objectives = [run.recipe.objective for run in runs]
    thetas = [run.theta for run in runs]
    stack = Objective.stacked(objectives, "cpu")
    stacked = torch.as_tensor(np.stack(thetas))
    ratio = median_ratio(
        lambda: [one(theta) for one, theta in zip(objectives, thetas, strict=True)],
        lambda: stack.values(stacked),
        repeats,
    )
    name = f"{MANY} records stacked / one after another, evaluations per CPU-second, on the CPU"
    return at_least(name, ratio, "x", None)
