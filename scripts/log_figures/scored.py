"""Logs scored against their references: a real car at fixes that were held out of its log and, on
logs of known truth, how near the scores are to those of the game."""

from __future__ import annotations

import csv
import math
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from benchmarks import Figure, at_most

from log_figures.recorded import LOGS, Car, columns
from pinnobs_gym.envs.game import Game
from pinnobs_gym.scoring.evaluation import evaluate
from pinnobs_gym.scoring.log_evaluation import evaluate_logs
from pinnobs_gym.scoring.metrics import SCORES
from pinnobs_gym.simulation.system import Setup, independent

ESTIMATORS = (("ekf", 3.4), ("ukf", 3.4), ("mhe", None), ("rts_smoother", 2.1))
"""Estimators of the car, with the largest error that is asked for, in m."""
SYSTEMS = ("ReverseDuffing", "HarmonicOscillator", "Satellite")


def figures(repeats: int) -> Iterator[Figure]:
    """Score the logs; the real ones are left out where they are not there."""
    with tempfile.TemporaryDirectory() as folder:
        yield same_as_game(Path(folder))
        if LOGS.exists():
            yield from car(Path(folder))


def car(folder: Path) -> Iterator[Figure]:
    """The error of the position at the fixes that were held out: its root mean square."""
    fixes = columns("car/held_out_fixes.csv")
    reference = folder / "fixes.csv"
    write(reference, ["t", "px", "py"], [fixes[name] for name in ("t", "px", "py")])
    log = LOGS / "car" / "log.csv"
    for name, asked in ESTIMATORS:
        (row,) = evaluate_logs(name, Car, [log], [reference], setup=start())
        rms = math.sqrt(2 * row["mse"])  # over both states
        what = f"pinnobs evaluate --log, car, {name}: position at held-out fixes"
        yield Figure(what, rms, "m", "", None) if asked is None else at_most(what, rms, "m", asked)


def start() -> Setup:
    """Return the setup of the car with the course that a driver knows: that of the first two fixes
    far enough apart."""
    log = columns("car/log.csv")
    seen = np.stack([log[name] for name in Car.output_names], axis=-1)
    seen = seen[np.isfinite(seen[:, 0])]
    away = int(np.flatnonzero(np.hypot(*(seen[:, :2] - seen[0, :2]).T) > 10.0)[0])
    east, north = seen[away, :2] - seen[0, :2]
    mean = (*seen[0, :2], math.atan2(north, east), seen[0, 2], 0.0, 0.0)
    P0 = independent(5.0, 5.0, 0.5, 1.0, 0.1, 0.5)
    return replace(Car.setups["benchmark"], xhat0=tuple(map(float, mean)), P0=P0)


def same_as_game(folder: Path) -> Figure:
    """The largest relative difference of the scores of a simulated episode, written as a log with
    its true states, from those of the game."""
    worst = 0.0
    for system in SYSTEMS:
        game = Game.of(system)
        model, record = game.source.system, game.record([3])
        truth = game.episodes([3]).x[: record.num_samples, 0]
        log, reference = folder / "log.csv", folder / "reference.csv"
        write(log, ["t", *(f"y{i + 1}" for i in range(model.ny))], [record.t, *record.y[0].T])
        write(reference, ["t", *model.state_names], [record.t, *truth.T])
        for name in ("ekf", "rts_smoother"):
            (own,) = evaluate_logs(name, system, [log], [reference])
            (played,) = evaluate(name, system, episodes=1, seed=3)
            pairs = ((own[score], played[score]) for score in SCORES)
            off = (abs(one - other) / max(abs(other), 1e-300) for one, other in pairs)
            worst = max(worst, *off)
    return at_most("scores of logs, from those of the same episodes simulated", worst, "", 1e-9)


def write(path: Path, names: list[str], values: list[np.ndarray]) -> None:
    """Write columns as CSV, with all digits."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(names)
        writer.writerows(zip(*(column.tolist() for column in values), strict=True))
