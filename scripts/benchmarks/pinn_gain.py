"""The shared gain against the EKF on episodes that neither has seen."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks import Figure, at_most, cpu_seconds
from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import PinnGain, TrainedGain
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import train_by_name
from trainers.pinn_gain import PinnGainConfig

SEEDS = 3
"""Number of training seeds; bounds apply to the median."""
EPISODES = 100
"""Number of episodes, with seeds 0, 1, ..."""
CONDITIONS = ("nominal", "noise5")
WHOLE = {"ReverseDuffing": 0.8, "InductionMotor": 0.8}
"""Bounds of the NRMSE over the whole episode, relative to the EKF's; 1 for other systems."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the shared gain, system by system."""
    for name in SYSTEMS.classes():
        yield from of_system(name, repeats)


def of_system(name: str, repeats: int) -> Iterator[Figure]:
    """Measure the figures of all training seeds on one system, their medians, and the speed."""
    ratios: dict[tuple[str, str], list[float]] = {}
    trainings = []
    for seed in range(SEEDS):
        trainings.append(trained_on(name, seed))
        yield at_most(f"training of {name}, seed {seed}", trainings[-1].seconds, "CPU s", 600.0)
        for condition in CONDITIONS:
            for what, value in compared(name, condition, trainings[-1]).items():
                ratios.setdefault((condition, what), []).append(value)
                yield Figure(f"{what}, {name}, {condition}, seed {seed}", value, "", "", None)
    for (condition, what), values in ratios.items():
        bound = asked(name, condition, what, ratios)
        title = f"{what}, {name}, {condition}, median of {SEEDS} seeds"
        median = float(np.median(values))
        known = bound is not None
        yield at_most(title, median, "", bound) if known else Figure(title, median, "", "", None)
    yield from speed(name, trainings[-1], repeats)


def trained_on(name: str, seed: int) -> Any:
    """Train a gain with the default settings."""
    config = PinnGainConfig(seed=seed)
    return train_by_name("pinn_gain", config, Game.of(name))


def compared(name: str, condition: str, trained: TrainedGain) -> dict[str, float]:
    """Compare a gain with the EKF, both with known noise; see `summary`."""
    env = env_id(name)
    source = Game.of(name, condition=condition).source
    system, setup = source.system, source.setup
    ekf, gain = EKF(system, setup.noise_std), PinnGain(system, setup.noise_std, trained=trained)
    scores = (evaluate(e, env, episodes=EPISODES, condition=condition) for e in (ekf, gain))
    return summary(*scores)


def summary(ekf: list[Row], gain: list[Row]) -> dict[str, float]:
    """Return both rates of divergence, and the gain's scores over the EKF's, all modulo
    indistinguishable states."""
    scores = {}
    for label, rows in (("EKF", ekf), ("gain", gain)):
        scores[f"diverged, {label}"] = float(
            np.mean([not r["nrmse_tail_modulo"] <= 0.2 for r in rows])
        )
    for what, key, part in (
        ("tail NRMSE", "nrmse_tail_modulo", 0.5),
        ("whole NRMSE", "nrmse_modulo", 0.5),
        ("settling median", "settling", 0.5),
        ("settling 90th percentile", "settling", 0.9),
    ):
        # Settling times may be infinite, so quantiles are taken without interpolation.
        own, peer = (
            np.quantile([r[key] for r in rows], part, method="higher") for rows in (gain, ekf)
        )
        scores[f"{what} / EKF's"] = float(own / peer)
    return scores


def asked(
    name: str, condition: str, what: str, scores: dict[tuple[str, str], list[float]]
) -> float | None:
    """Return the bound of a median, if it has one."""
    if what == "diverged, gain":
        return 0.0 if condition == "nominal" else scores[condition, "diverged, EKF"][0]
    if what == "tail NRMSE / EKF's":
        return 1.15
    if condition != "nominal":
        return None
    if what == "whole NRMSE / EKF's":
        return WHOLE.get(name, 1.0)
    if what == "settling 90th percentile / EKF's" and name == "ReverseDuffing":
        return 0.5
    return None


def speed(name: str, trained: TrainedGain, repeats: int) -> Iterator[Figure]:
    """Measure the time per step and episode of a batch of 256."""
    game = Game.of(name)
    system, setup, record = game.source.system, game.source.setup, game.record(range(256))
    steps = record.batch * record.num_samples
    gain = PinnGain(system, setup.noise_std, trained=trained)
    for label, estimator in (("EKF", EKF(system, setup.noise_std)), ("gain", gain)):
        seconds = [cpu_seconds(lambda e=estimator: e.run(record)) for _ in range(repeats)]
        value = float(np.median(seconds)) / steps * 1e6
        title = f"{label} of 256 episodes of {name}, per step and episode"
        yield Figure(title, value, "µs", "", None)
