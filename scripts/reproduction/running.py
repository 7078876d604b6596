"""Run one case: train, store the results and measure."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import torch
from machine import processor

from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.pinn_obs import PinnObsDirect, PinnObsReplay, TrainedNetwork
from pinnobs_gym.files import replacing_folder
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.provenance import canonical, versions
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.training.log import Log
from pinnobs_gym.training.loop import train
from reproduction.figures import estimates_figure, loss_figure, readable_gain_figure
from reproduction.tables import Case
from trainers.pinn_obs import PinnObsConfig, PinnObsTrainer

SETUP = "paper"
SEED = 0
"""Setup, condition and seed of the episode."""
REPEATS = 20
"""Number of timings of inference, of which the median is taken."""
CHECKPOINT = "checkpoint.pt"


@dataclass(frozen=True)
class PaperJob:
    """The training of a case."""

    case: Case
    preset: str
    """Name of the preset from which the config is derived."""
    config: PinnObsConfig
    out: Path
    """Folder of all output."""

    @property
    def key(self) -> str:
        """Hash of all that determines the result; jobs with the same key are identical."""
        return _digest(self.case, self.config)

    @property
    def folder(self) -> Path:
        """Folder of the checkpoint, curves and figures for this budget."""
        budget = self.config.budget
        return self._training / ("to-the-end" if budget is None else f"budget-{budget:g}")

    @property
    def _training(self) -> Path:
        """Folder of this training with all budgets; a larger budget resumes from the checkpoint of
        a smaller one."""
        config = self.config
        network = f"{config.depth}x{config.width}-{config.activation}"
        digest = _digest(self.case, replace(config, budget=None))
        return self.out / f"{self.case.system}-{self.preset}-{network}-{digest}"

    def prepare(self) -> bool:
        """Create the folder; return whether it has a checkpoint to resume from, its own or a copy
        of that of the next smaller budget."""
        if (self.folder / CHECKPOINT).exists():
            return True
        shutil.rmtree(self.folder, ignore_errors=True)  # stopped before the first checkpoint
        own = math.inf if self.config.budget is None else self.config.budget
        earlier = {
            float(path.parent.name.removeprefix("budget-")): path.parent
            for path in self._training.glob(f"budget-*/{CHECKPOINT}")
        }
        smaller = [budget for budget in earlier if budget < own]
        if smaller:
            with replacing_folder(self.folder) as part:
                shutil.copytree(earlier[max(smaller)], part, dirs_exist_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        return bool(smaller)


def _digest(case: Case, config: PinnObsConfig) -> str:
    kind = f"{PinnObsConfig.__module__}.{PinnObsConfig.__qualname__}"
    decides = {"system": case.system, "played": (SETUP, SEED), kind: config}
    text = json.dumps(canonical(decides), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def run(job: PaperJob, progress: bool = False) -> Row:
    """Train a case, from its checkpoint if it has one, draw its figures, and measure.

    Returns:
        A row: ``key``, ``case``, ``system``, ``preset``, ``config``; the ``loss``; the number of
        ``iterations``, and ``best_iteration``, that of the least loss to within ``log_every``; the
        CPU ``seconds`` of the training; ``inference_ms``; ``rmse`` and ``mae`` of the network, and
        ``replay_rmse`` and ``replay_mae`` of the observer with its gain, over the whole record in
        state units; ``date``, ``processor`` and ``versions``.

    Raises:
        KeyboardInterrupt: on Ctrl-C; the last checkpoint is kept.
    """
    torch.set_num_threads(1)
    game = _game(job)
    system, record = game.source.system, game.record([SEED])
    checkpoint, resume = job.folder / CHECKPOINT, job.prepare()
    noise_std = game.source.setup.noise_std
    trainer = PinnObsTrainer(system, job.config, record=record, noise_std=noise_std)
    with Log(job.folder / "tensorboard") as log:
        trained = train(trainer, log=log, checkpoint=checkpoint, resume=resume, progress=progress)
    if trained.ending == "interrupted":  # an interrupted training is not a result
        raise KeyboardInterrupt
    trained.save(job.folder / "trained.pt")
    scores, curve = _scores(job, game, trained), loss_curve(job.folder / "tensorboard")
    write_figure(job.folder / "gain.png", readable_gain_figure(trained))
    write_figure(job.folder / "loss.png", loss_figure(curve, f"{trained.system}: as minimised"))
    budget = job.config.budget
    if budget is None or trained.seconds < budget:  # no larger budget needs it
        checkpoint.unlink(missing_ok=True)
    return {
        "key": job.key,
        "case": job.case.name,
        "system": job.case.system,
        "preset": job.preset,
        "config": asdict(job.config),
        "loss": trained.loss,
        "iterations": trained.iterations,
        "best_iteration": int(curve[np.argmin(curve[:, 1]), 0]),
        "seconds": trained.seconds,
        "inference_ms": inference_ms(trained),
        **scores,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": processor(),
        "versions": versions(),
    }


def _game(job: PaperJob) -> Game:
    """Return the game of the paper's setup."""
    return Game.of(job.case.system, SETUP)


def _scores(job: PaperJob, game: Game, trained: TrainedNetwork) -> Row:
    """Score the network and its replay, and draw a figure of each."""
    scores: Row = {}
    for prefix, picture, cls in (
        ("", "states", PinnObsDirect),
        ("replay_", "replay", PinnObsReplay),
    ):
        played = play(game, cls(game.source.system, trained=trained), [SEED])
        row: Row = played.scores.rows()[0]
        scores |= {f"{prefix}{name}": row[name] for name in ("rmse", "mae")}
        rmse = f"RMSE {row['rmse']:.3g}" if math.isfinite(row["rmse"]) else "diverges"
        figure = estimates_figure(played, f"{job.case.system}, {cls.name}: {rmse}")
        write_figure(job.folder / f"{picture}.png", figure)
    return scores


def inference_ms(trained: TrainedNetwork) -> float:
    """Measure the median time in ms of the network's evaluation at all times of the record, in one
    thread."""
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        trained.xhat(trained.t)
        taken.append(time.perf_counter() - start)
    return 1e3 * float(np.median(taken))


def loss_curve(folder: Path) -> np.ndarray:
    """Read iterations and the least loss so far, (num_points, 2), from a TensorBoard log."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    # A training resumed from a checkpoint repeats some iterations.
    points = {event.step: event.value for event in events.Scalars("loss/best")}
    return np.array(sorted(points.items()), dtype=float)
