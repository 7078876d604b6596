"""Print what a system's estimators and truth take in this process, which uses kernels or none:
SYSTEM REPEATS."""

from __future__ import annotations

import json
import sys

import numpy as np

from kernel_figures.timing import medians, repeated
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.estimators.mhe import MHE
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.truth import truth

BATCHES = (1, 65, 1024)
"""Numbers of episodes of the truth."""
PROCESS_NOISE = 0.01
"""Process noise of the windows whose states are all unknown."""


def main(name: str, repeats: str) -> None:
    """Measure and print."""
    source = EpisodeSource(name)
    found = {f"truth, {batch}": truth_time(source, batch, int(repeats)) for batch in BATCHES}
    record = repeated(name, 1, 61)
    for estimator in estimators(source):
        found[described(estimator)] = update_time(estimator, record, int(repeats))
    print(json.dumps(found))


def estimators(source: EpisodeSource) -> list[Estimator]:
    """Return all estimators that give an estimate at each sample and need no training."""
    made: list[Estimator] = []
    for cls in ESTIMATORS.classes().values():
        try:
            estimator = cls(source.system)
        except (TypeError, ValueError):  # it is trained, or not for this plant
            continue
        if isinstance(estimator, Estimator):
            made.append(estimator)
    noisy = MHE(source.system, process_noise=PROCESS_NOISE, window=20)
    return [*made, MHE(source.system, window=20), noisy]


def described(estimator: Estimator) -> str:
    """Return the label of an estimator, of a moving horizon with its window and process noise."""
    if not isinstance(estimator, MHE):
        return estimator.label
    noise = ", process noise" if estimator.noise.told.stochastic else ""
    return f"{estimator.label}, window {estimator.window}{noise}"


def update_time(estimator: Estimator, record: Record, repeats: int) -> float:
    """Return the time in µs of a single update of one episode."""
    inputs: list[tuple[float, np.ndarray, np.ndarray]] = [
        (t, record.y[:, k], record.u[:, k]) for k, t in enumerate(record.t.tolist())
    ]

    def play() -> None:
        state = estimator.reset(record.prior)
        for t, y, u in inputs:
            state = estimator.update(state, t, y, u)

    seconds = medians([play, lambda: estimator.reset(record.prior)], repeats)
    return float(seconds[0] - seconds[1]) / len(inputs) * 1e6


def truth_time(source: EpisodeSource, batch: int, repeats: int) -> float:
    """Return the time in ns of the truth, per sample and episode."""
    x0 = np.concatenate([source.draw([s]).x0 for s in source.streams(range(batch))])

    def solve() -> None:
        truth(source.system, x0, source.times, source.setup.truth_step)

    return float(medians([solve], repeats)[0]) / (batch * len(source.times)) * 1e9


if __name__ == "__main__":
    main(*sys.argv[1:])
