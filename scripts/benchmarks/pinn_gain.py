"""The shared gain against the EKF on episodes that neither has seen."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks import Figure, at_most, cpu_seconds
from pinnobs_gym import env_id, evaluate
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_gain import PinnGain
from pinnobs_gym.rows import Row
from pinnobs_gym.suite import TRAINING_SEED, record_of
from pinnobs_gym.systems import SYSTEMS
from trainers.pinn_gain import Config, train

SEEDS = 3
"""Training seeds, of which the median counts."""
EPISODES = 100
"""Episodes of seeds 0, 1, ..."""
CONDITIONS = ("nominal", "noise5")
WHOLE = {"ReverseDuffing": 0.8, "InductionMotor": 0.8}
"""Asked of the whole window's NRMSE over the EKF's; one elsewhere."""


def figures(repeats: int) -> Iterator[Figure]:
    """The shared gain, system by system."""
    for name in SYSTEMS.classes():
        yield from of_system(name, repeats)


def of_system(name: str, repeats: int) -> Iterator[Figure]:
    """The figures of all training seeds on one system, then their medians."""
    env, ratios = env_id(name), {}
    config = Config()
    system, setup, record = record_of(env, "benchmark", "nominal", TRAINING_SEED, config.episodes)
    for seed in range(SEEDS):
        start = time.process_time()
        trained = train(
            system, replace(config, seed=seed), record=record, noise_std=setup.noise_std
        )
        yield at_most(
            f"training of {name}, seed {seed}", time.process_time() - start, "CPU s", 600.0
        )
        for condition in CONDITIONS:
            told = record_of(env, "benchmark", condition, 0)[1].noise_std
            gain = PinnGain(system, told, trained=trained)
            ekf = EKF(system, told)
            scores = [evaluate(e, env, episodes=EPISODES, condition=condition) for e in (ekf, gain)]
            for what, value in summary(*scores).items():
                ratios.setdefault((condition, what), []).append(value)
                yield Figure(f"{what}, {name}, {condition}, seed {seed}", value, "", "", None)
    for (condition, what), values in ratios.items():
        bound = asked(name, condition, what, ratios)
        median = float(np.median(values))
        title = f"{what}, {name}, {condition}, median of {SEEDS} seeds"
        yield (
            Figure(title, median, "", "", None)
            if bound is None
            else at_most(title, median, "", bound)
        )
    yield from speed(name, gain, repeats)


def summary(ekf: list[Row], gain: list[Row]) -> dict[str, float]:
    """Both rates of divergence, and the gain's figures over the EKF's, all modulo states that no
    output tells apart."""
    found = {}
    for label, rows in (("EKF", ekf), ("gain", gain)):
        found[f"diverged, {label}"] = float(
            np.mean([not r["nrmse_tail_modulo"] <= 0.2 for r in rows])
        )
    for what, key, part in (
        ("tail NRMSE", "nrmse_tail_modulo", 0.5),
        ("whole NRMSE", "nrmse_modulo", 0.5),
        ("settling median", "settling", 0.5),
        ("settling 90th percentile", "settling", 0.9),
    ):
        # inf stands for an episode that never settles; interpolation between two would be nan
        own, peer = (
            np.quantile([r[key] for r in rows], part, method="higher") for rows in (gain, ekf)
        )
        found[f"{what} / EKF's"] = float(own / peer)
    return found


def asked(
    name: str, condition: str, what: str, found: dict[tuple[str, str], list[float]]
) -> float | None:
    """What is asked of a median, if anything."""
    if what == "diverged, gain":
        return 0.0 if condition == "nominal" else found[condition, "diverged, EKF"][0]
    if what == "tail NRMSE / EKF's":
        return 1.15
    if condition != "nominal":
        return None
    if what == "whole NRMSE / EKF's":
        return WHOLE.get(name, 1.0)
    if what == "settling 90th percentile / EKF's" and name == "ReverseDuffing":
        return 0.5
    return None


def speed(name: str, gain: PinnGain, repeats: int) -> Iterator[Figure]:
    """Time per step and episode of a batch of 256."""
    record = record_of(env_id(name), "benchmark", "nominal", 0, 256)[2]
    steps = record.batch * record.num_samples
    for label, estimator in (("EKF", EKF(gain.system, gain.noise_std)), ("gain", gain)):
        seconds = [cpu_seconds(lambda e=estimator: e.run(record)) for _ in range(repeats)]
        value = float(np.median(seconds)) / steps * 1e6
        yield Figure(
            f"{label} of 256 episodes of {name}, per step and episode", value, "µs", "", None
        )
