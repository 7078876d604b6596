"""PINN-Obs on many records."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch

from benchmarks import Figure, at_least, cpu_seconds, median_ratio
from pinnobs_gym.envs.episodes import EpisodeSource, Stream
from pinnobs_gym.simulation.record import Record
from trainers.pinn_obs import Config, train, train_many
from trainers.pinn_obs.fast import FastRun
from trainers.pinn_obs.objective import Objective

MANY = 64
SINGLE = 4
"""How many records are taken for the time of one."""
ITERATIONS = 60


def figures(repeats: int) -> Iterator[Figure]:
    """PINN-Obs on many records."""
    source = EpisodeSource("ReverseDuffing")
    streams = [Stream(np.random.SeedSequence(seed)) for seed in range(MANY)]
    record = source.record(source.play(source.draw(streams)))
    yield at_once(source, record, repeats)
    yield stacked_evaluations(source, record, repeats)


def at_once(source: EpisodeSource, record: Record, repeats: int) -> Figure:
    """Records per CPU-second of `train_many` over those of `train`, in the first iterations of the
    fast preset, which all cost the same."""
    system, noise = source.system, source.setup.noise_std
    config = Config(iterations=ITERATIONS)

    def single() -> None:
        for i in range(SINGLE):
            train(system, config, record=record.rows(slice(i, i + 1)), noise_std=noise)

    single()
    ratios = []
    for _ in range(repeats):
        one = cpu_seconds(single) / SINGLE
        many = cpu_seconds(lambda: train_many(system, config, record=record, noise_std=noise))
        ratios.append(one / (many / MANY))
    where = "on a GPU" if torch.cuda.is_available() else "on the CPU"
    name = f"{MANY} records by train_many / one by train, records per CPU-second, {where}"
    return at_least(name, float(np.median(ratios)), "x", 8.0)


def stacked_evaluations(source: EpisodeSource, record: Record, repeats: int) -> Figure:
    """Losses and gradients per CPU-second of the stack that a GPU is given over those of single
    records, both on the CPU: why `train_many` takes one record after another there."""
    noise = np.broadcast_to(source.setup.noise_std, source.system.ny)
    rows = [record.rows(slice(i, i + 1)) for i in range(MANY)]
    config = Config(guide=0.0)  # which takes no part in the time of an evaluation
    runs = [FastRun(source.system, config, row, noise) for row in rows]
    stack = Objective.stacked([run.objective for run in runs], "cpu")
    thetas = torch.as_tensor(np.stack([run.theta for run in runs]))
    ratio = median_ratio(
        lambda: [run.objective(run.theta) for run in runs],
        lambda: stack.values(thetas),
        repeats,
    )
    name = f"{MANY} records stacked / one after another, evaluations per CPU-second, on the CPU"
    return at_least(name, ratio, "x", None)
