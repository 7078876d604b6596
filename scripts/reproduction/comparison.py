"""Comparison of PINN-Obs and the three learned KKL observers on the same ReverseDuffing records."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.estimation.estimator import labelled
from pinnobs_gym.estimators.kkl import KKL
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay
from pinnobs_gym.files import append_lines
from pinnobs_gym.scoring.metrics import error_scores
from pinnobs_gym.scoring.provenance import canonical
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.training.loop import train
from pinnobs_gym.training.trainer import Trainer
from trainers.kkl_autoencoder import KKLAutoencoderTrainer
from trainers.kkl_pinn import KKLPinnTrainer
from trainers.kkl_supervised import KKLSupervisedTrainer
from trainers.pinn_obs import PinnObsTrainer

METHODS: Mapping[str, type[Trainer[Any, Any]]] = {
    "pinn_obs": PinnObsTrainer,
    "pinn_obs_replay": PinnObsTrainer,
    "kkl_pinn": KKLPinnTrainer,
    "kkl_supervised": KKLSupervisedTrainer,
    "kkl_autoencoder": KKLAutoencoderTrainer,
}
"""The trainer of each method."""
METRICS = ("mse", "rmse", "mae", "smape")
PRINTED: Mapping[str, tuple[float | None, ...]] = {
    "pinn_obs": (5.56e-6, 0.00236, 0.00175, 1.18),
    "kkl_pinn": (3.54e-5, 0.00595, None, None),
    "kkl_supervised": (3.94e-5, 0.00628, None, None),
    "kkl_autoencoder": (4.39e-5, 0.00663, None, None),
}
"""Figures printed in the paper, "Comparison with Existing Methods", in the order of `METRICS`; the
others are shown as bars only."""
WINDOWS = {"whole": 0.0, "from 10 s": 10.0}
"""Start in s of each scored window."""
HEADER = ("method", "by", "window", "statistic", "MSE", "RMSE", "MAE", "SMAPE %", "training s")


@dataclass(frozen=True)
class Comparison:
    """Settings of the comparison."""

    preset: str
    """Recipe of PINN-Obs: guided, plain or paper."""
    budget: float | None
    """CPU seconds of each training."""
    seed: int
    """Seed of the initial weights."""
    records: int
    """Number of records: benchmark episodes with seeds 0, 1, ..."""

    def config(self, method: str) -> Any:
        """Return the config of a method."""
        common: dict[str, Any] = {"seed": self.seed, "budget": self.budget}
        if method.startswith("pinn_obs"):
            transfer = method == "pinn_obs_replay" and self.preset == "guided"
            common |= {"preset": "transfer" if transfer else self.preset}
        else:
            common |= {"start": "zero", "transient": False, "noise": False}
        return METHODS[method].configured(common)

    def key(self, method: str, episode: int) -> str:
        """Return a hash of all that determines a method's scores on an episode."""
        text = json.dumps([method, episode, canonical(self.config(method))], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def protocol(self) -> list[str]:
        """Return the paragraphs that describe how the figures are obtained."""
        source = compared()
        setup = source.setup
        return [
            f"Ours: ReverseDuffing without noise, {self.records} initial states of the benchmark's "
            f"set (episodes of seeds 0 to {self.records - 1}), {setup.num_steps} samples over "
            f"{setup.duration:g} s. Every method sees the same records. Errors are over both "
            "states, in state units; mean and median are over the records. SMAPE is large wherever "
            "a state passes zero.",
            "PINN-Obs is trained on each record by itself, from x̂₀ = [1, 1], and scored offline by "
            "the network's own x̂(t). pinn_obs_replay is the observer with the learned L(t) on the "
            "same record, online; its gain is trained to transfer, where the recipe can. The guide "
            "is a Kalman smoother of the same record, and is not part of the paper's method. "
            "The KKL observers are each trained once, on simulated episodes of the benchmark's set "
            "with their true states, without noise, and run online on every record from z₀ = 0; "
            "time is not an input of T*. Training is CPU seconds of one thread, for PINN-Obs those "
            "of one record (the median).",
            "The paper's: one bar for each method and metric. It does not state its initial "
            "states, z₀, window or noise, and whether they are of one record; its figures of "
            "PINN-Obs cannot include the sample at t₀ (see the table of examples).",
        ]


def compared() -> EpisodeSource:
    """Where the records that are compared come from."""
    return EpisodeSource("ReverseDuffing", condition="poor_prior", noise_std=0.0)


def played(records: int) -> tuple[Record, np.ndarray]:
    """Return the records, and their true states (records, num_samples, nx)."""
    source = compared()
    streams = source.streams(range(records))
    episodes = source.play(source.draw(streams))
    record = source.record(episodes)
    return record, episodes.x[: record.num_samples].swapaxes(0, 1)


def run(comparison: Comparison, results: Path, known: set[str]) -> Iterator[str]:
    """Train and score the missing cases, store each row at once, and yield progress messages."""
    torch.set_num_threads(1)
    record, x = played(comparison.records)
    system = compared().system
    for method, trainer in METHODS.items():
        config = comparison.config(method)
        keys = [comparison.key(method, i) for i in range(comparison.records)]
        missing = [i for i, key in enumerate(keys) if key not in known]
        if not missing:
            continue
        if not method.startswith("pinn_obs"):
            first = record.rows(slice(0, 1))
            trained = train(trainer(system, config, record=first, noise_std=0.0))
            xhat = KKL(system, trained=trained).run(record).xhat
            rows = [_row(comparison, method, i, trained, record.t, x[i], xhat[i]) for i in missing]
            append_lines(results, rows)
            yield f"{method}: trained in {trained.seconds:.0f} CPU s, run on {len(rows)} records"
            continue
        for i in missing:
            own = record.rows(slice(i, i + 1))
            trained = train(trainer(system, config, record=own, noise_std=0.0))
            replayed = method == "pinn_obs_replay"
            observer = PinnObsReplay(system, trained=trained)
            xhat = observer.run(own).xhat[0] if replayed else trained.xhat(record.t)
            append_lines(results, [_row(comparison, method, i, trained, record.t, x[i], xhat)])
            yield f"{method}: record {i} of {comparison.records}, {trained.seconds:.1f} CPU s"


def _row(
    comparison: Comparison,
    method: str,
    episode: int,
    trained: Any,
    t: np.ndarray,
    x: np.ndarray,
    xhat: np.ndarray,
) -> Row:
    scores = {}
    for window, start in WINDOWS.items():
        late = t >= start - 1e-9
        values = error_scores(
            t[late], x[None, late], xhat[None, late], (1.0, 1.0), transient_end=5.0
        )
        scores[window] = {metric: float(values[metric][0]) for metric in METRICS}
    key = comparison.key(method, episode)
    seconds = trained.seconds
    config = asdict(comparison.config(method))
    return {"key": key, "method": method, "scores": scores, "seconds": seconds, "config": config}


def read(path: Path) -> dict[str, Row]:
    """Read the rows by key; none if the file does not exist.

    Raises:
        ValueError: in one line, if a line of the file is not a row.
    """
    results: dict[str, Row] = {}
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            results[row["key"]] = row
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{path}, line {number}, is cut off or no result: {line[:40]!r}; delete that line "
                "and run again"
            ) from None
    return results


def lines(comparison: Comparison, rows: Mapping[str, Row]) -> list[tuple[str, ...]]:
    """Return the rows of the table: for each method the paper's, then ours."""
    table: list[tuple[str, ...]] = []
    for method in METHODS:
        if method in PRINTED:
            printed = ["" if value is None else f"{value:.3g}" for value in PRINTED[method]]
            table.append((method, "the paper", "not stated", "not stated", *printed, ""))
        name = labelled(method, comparison.config(method).recipe)
        own = [rows.get(comparison.key(method, i)) for i in range(comparison.records)]
        present = [row for row in own if row is not None]
        seconds = f"{np.median([row['seconds'] for row in present]):.0f}" if present else ""
        for window in WINDOWS if present else ():
            for statistic, of in (("mean", np.mean), ("median", np.median)):
                values = [of(_values(present, window, metric)) for metric in METRICS]
                shown = [f"{value:.3g}" for value in values]
                table.append((name, "ours", window, statistic, *shown, seconds))
    return table


def _values(rows: Sequence[Row], window: str, metric: str) -> list[float]:
    values = [row["scores"][window][metric] for row in rows]
    return [math.inf if value is None else value for value in values]


def markdown(comparison: Comparison, rows: Mapping[str, Row]) -> str:
    """Return the table with its protocol as Markdown."""
    cells = [HEADER, ("---",) * 4 + ("---:",) * 5, *lines(comparison, rows)]
    body = "\n".join("| " + " | ".join(line) + " |" for line in cells)
    title = "# PINN-Obs and learned KKL observers on ReverseDuffing"
    return "\n\n".join([title, body, *comparison.protocol()]) + "\n"
