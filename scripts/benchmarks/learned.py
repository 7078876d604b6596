"""The learned bank `robust_gain` against the best classical estimator of each condition, and exact
Bayes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks import Figure, at_most
from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimators.robust_gain import RobustGain, TrainedBeliefs
from pinnobs_gym.leaderboard.published.reading import published_floors
from pinnobs_gym.scoring.floor import run_floor
from pinnobs_gym.scoring.identifiability import identifiability
from pinnobs_gym.scoring.row_format import FLOOR
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.conditions import fitting
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import train_by_name
from trainers.robust_gain import RobustGainConfig

SEEDS = 5
"""Number of training seeds; bounds apply to medians over them."""
EPISODES = 100
"""Number of episodes, with seeds 0, 1, ..."""
CLASSICAL: tuple[tuple[str, dict[str, Any]], ...] = (
    ("ekf", {}),
    ("ukf", {}),
    ("ukf", {"tuned": True}),
    ("robust_ekf", {}),
    ("robust_ekf", {"tuned": True}),
    ("strong_tracking_ekf", {}),
    ("mhe", {}),
    ("mhe", {"tuned": True}),
)
"""What it is compared with, by name and options of `evaluate`."""
WITHOUT = ("noise0",)
"""Conditions in which errors vanish, and ratios say nothing."""
CONSISTENT = ("nominal", "noise5", "outliers", "dropout30", "mismatch10", "process_noise1e-3")
"""Conditions under which the covariance is judged."""
FLOOR_EPISODES = 30
"""Number of episodes of exact Bayes that are not shipped."""
WINDOWS = ("transient", "steady")
BUDGET = 300.0
"""CPU seconds of a training that were asked."""
Scores = dict[str, float]


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the bank, system by system."""
    for name in SYSTEMS.classes():
        yield from of_system(name)


def of_system(name: str) -> Iterator[Figure]:
    """Measure all figures on one system."""
    trained = [trained_on(name, seed, "states") for seed in range(SEEDS)]
    seconds = [each.seconds for each in trained]
    yield at_most(f"{name}: training, worst of {SEEDS} seeds", max(seconds), "CPU s", BUDGET)
    yield Figure(
        f"{name}: hypotheses, median", float(np.median([len(t.beliefs.belief) for t in trained])),
        "", "", None,
    )  # fmt: skip
    ratios: dict[str, list[float]] = {}
    singles: dict[str, list[float]] = {}
    for condition in conditions_of(name):
        game = Game.of(name, condition=condition)
        classical = {label: scores_of(classical_rows(name, condition, label)) for label in LABELS}
        own = [scores_of(rows_of(name, condition, each)) for each in trained]
        found = identifiability(game)
        counts = found is None or found.holds
        yield from of_cell(name, condition, own, classical, counts)
        if not counts:
            continue
        for window in WINDOWS:
            for statistic in ("median", "rms"):
                key = f"{window} {statistic}"
                value = float(np.median([scores[key] for scores in own]))
                ratios.setdefault(key, []).append(value)
                for label, scores in classical.items():
                    singles.setdefault(f"{key} {label}", []).append(scores[key])
    for key, values in ratios.items():
        # The classical estimator with the least geometric mean over the same conditions
        means = {label: geometric(singles[f"{key} {label}"]) for label in LABELS}
        best = min(means, key=lambda label: means[label])
        title = f"{name}: {key}, geometric mean over conditions / {best}'s"
        yield at_most(title, geometric(values) / means[best], "", 0.75)
    outputs = trained_on(name, 0, "outputs")
    for condition in ("nominal", "mismatch10", "outliers"):
        told = scores_of(rows_of(name, condition, outputs))
        states = scores_of(rows_of(name, condition, trained[0]))
        for window in WINDOWS:
            title = f"{name}, {condition}: {window} median, learned from outputs / from states"
            key = f"{window} median"
            yield Figure(title, told[key] / states[key], "", "", None)


def of_cell(
    name: str, condition: str, own: list[Scores], classical: dict[str, Scores], counts: bool
) -> Iterator[Figure]:
    """Compare the bank with the best classical estimator of one condition.

    Args:
        name: the system.
        condition: the condition.
        own: the bank's scores of each training seed.
        classical: scores of the classical estimators by their labels.
        counts: whether outputs tell the states under this condition.
    """
    where = f"{name}, {condition}" + ("" if counts else " (not identifiable)")
    for window in WINDOWS:
        for statistic in ("median", "rms"):
            key = f"{window} {statistic}"
            best = min(classical, key=lambda label: classical[label][key])
            value = float(np.median([scores[key] for scores in own])) / classical[best][key]
            bound = 1.05 if condition == "nominal" and window == "transient" else 1.10
            title = f"{where}: {key} / {best}'s"
            yield at_most(title, value, "", bound) if counts else Figure(title, value, "", "", None)
    diverged = float(np.median([scores["diverged"] for scores in own]))
    least = min(scores["diverged"] for scores in classical.values())
    yield at_most(f"{where}: diverged", diverged, "%", least)
    if condition not in CONSISTENT:
        return
    anees = float(np.median([scores["anees"] for scores in own]))
    coverage = float(np.median([scores["coverage"] for scores in own]))
    reference, what = consistent(name, condition)
    title = f"{where}: median ANEES / {what}"
    if counts:
        value = anees / reference
        yield Figure(title, value, "", ">= 0.8, <= 1.25", bool(0.8 <= value <= 1.25))
        good = bool(0.85 <= coverage <= 0.95)
        yield Figure(f"{where}: coverage of 90 %", coverage, "", ">= 0.85, <= 0.95", good)
    else:
        yield Figure(title, anees / reference, "", "", None)
        yield Figure(f"{where}: coverage of 90 %", coverage, "", "", None)
    if condition == "nominal" and (floor := floor_rows(name, condition)):
        of_bayes = scores_of(floor)["steady rms"]
        own_rms = float(np.median([scores["steady rms"] for scores in own]))
        yield at_most(f"{where}: steady rms / exact Bayes's", own_rms / of_bayes, "", 1.05)


def conditions_of(name: str) -> Sequence[str]:
    """Return the conditions that a system can be played under."""
    source = Game.of(name).source
    return [each for each in fitting(source.system, source.setup) if each not in WITHOUT]


def trained_on(name: str, seed: int, supervision: Any) -> TrainedBeliefs:
    """Train with the default settings."""
    config = RobustGainConfig(seed=seed, supervision=supervision)
    trained = train_by_name("robust_gain", config, Game.of(name))
    assert isinstance(trained, TrainedBeliefs)
    return trained


def rows_of(name: str, condition: str, trained: TrainedBeliefs) -> list[Row]:
    """Score one trained bank."""
    source = Game.of(name, condition=condition).source
    setup = source.setup
    bank = RobustGain(source.system, setup.noise_std, setup.process_noise, trained=trained)
    return evaluate(bank, env_id(name), episodes=EPISODES, condition=condition)


LABELS = [name + (" (tuned)" if options else "") for name, options in CLASSICAL]


@cache
def classical_rows(name: str, condition: str, label: str) -> tuple[Row, ...]:
    """Score a classical estimator."""
    estimator, options = CLASSICAL[LABELS.index(label)]
    rows = evaluate(estimator, env_id(name), episodes=EPISODES, condition=condition, **options)
    return tuple(rows)


def scores_of(rows: Sequence[Row]) -> Scores:
    """Return the scores of a game; those of a diverged episode are large."""
    scores = {"diverged": 100 * float(np.mean([row["diverged"] for row in rows]))}
    for window in WINDOWS:
        values = np.array([row[f"nrmse_{window}"] for row in rows], dtype=float)
        values = np.minimum(np.nan_to_num(values, nan=1e3, posinf=1e3), 1e3)
        scores[f"{window} median"] = float(np.median(values))
        scores[f"{window} rms"] = float(np.sqrt(np.mean(values**2)))
    for key in ("anees", "coverage"):
        values = [row[key] for row in rows if row.get(key) is not None]
        scores[key] = float(np.median(values) if key == "anees" else np.mean(values or [np.nan]))
    return scores


def consistent(name: str, condition: str) -> tuple[float, str]:
    """Return the median ANEES of a consistent estimator, and whose it is."""
    nx = SYSTEMS.resolve(name)().nx
    if condition.startswith("process_noise"):
        return 1.0, "1"  # samples of an episode are nearly independent
    if rows := floor_rows(name, condition):
        return scores_of(rows)["anees"], "exact Bayes's"
    return float(chi2.median(nx) / nx), f"the median of χ²/{nx}"


@cache
def floor_rows(name: str, condition: str) -> tuple[Row, ...]:
    """Return the rows of exact Bayes: the shipped ones, or computed ones of fewer episodes."""
    system = SYSTEMS.resolve(name)()
    if system.nx > 3 or condition.startswith("process_noise"):
        return ()
    game = Game.of(name, condition=condition)
    shipped = [row for row in published_floors([game.name]) if row["track"] == FLOOR]
    if not shipped:
        with tempfile.TemporaryDirectory() as folder:
            rows = run_floor(game, range(FLOOR_EPISODES), Path(folder) / "rows.jsonl")
        shipped = [row for row in rows if row["track"] == FLOOR]
    return tuple(shipped)


def geometric(values: Sequence[float]) -> float:
    """Return the geometric mean."""
    return float(np.exp(np.mean(np.log(values))))
