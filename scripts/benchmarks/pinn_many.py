"""PINN-Obs on many records."""

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

MANY = 256 if torch.cuda.is_available() else 64
SINGLE = 4
"""Number of records by which the time of a single training is measured."""
ITERATIONS = 300


def figures(repeats: int) -> Iterator[Figure]:
    """Measure PINN-Obs on many records."""
    source = EpisodeSource("ReverseDuffing")
    streams = source.streams(range(MANY))
    record = source.record(source.play(source.draw(streams)))
    yield at_once(source, record, repeats)
    yield guides_at_once(source, record, repeats)
    yield stacked_evaluations(source, record, repeats)


def at_once(source: EpisodeSource, record: Record, repeats: int) -> Figure:
    """Compare the records per second of `train_rows` with those of `train` on one core.

    Only the first iterations of the guided preset are run.
    """
    system, noise = source.system, source.setup.noise_std
    config = PinnObsConfig(iterations=ITERATIONS)

    def single() -> None:
        for i in range(SINGLE):
            row = record.rows(slice(i, i + 1))
            train(PinnObsTrainer(system, config, record=row, noise_std=noise))

    def together() -> None:
        PinnObsTrainer.train_rows(system, config, record=record, noise_std=noise)

    single()
    ratios = []
    for _ in range(repeats):
        one = cpu_seconds(single) / SINGLE
        start = time.perf_counter()  # of a GPU, the CPU's time is not all
        many = cpu_seconds(together)
        many = time.perf_counter() - start if torch.cuda.is_available() else many
        ratios.append(one / (many / MANY))
    where = "on a GPU" if torch.cuda.is_available() else "on the CPU"
    name = f"{MANY} records by train_rows / one by train, records per second, {where}"
    return at_least(name, float(np.median(ratios)), "x", 50.0)


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
