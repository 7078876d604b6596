"""Valid inputs, which trials damage."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.live import Live
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.scoring.episode_folder import write_folder
from pinnobs_gym.scoring.issue import Issue
from pinnobs_gym.training.by_name import trainer_of
from pinnobs_gym.training.checkpoint import save_checkpoint

SYSTEM = "HarmonicOscillator"
SMALL_TRAINING = {"trajectories": 60, "samples": 20, "iterations": 5, "width": 4}
"""Settings of a training whose checkpoint is small."""


@dataclass(frozen=True)
class Material:
    """Valid inputs in a folder, each made when it is first asked for."""

    folder: Path

    def file(self, name: str) -> Path:
        """Return a path in the folder."""
        return self.folder / name

    @cached_property
    def game(self) -> Game:
        """The game of all inputs."""
        return Game.of(SYSTEM, "benchmark", "nominal")

    @cached_property
    def record(self) -> Any:
        """A short record of it."""
        whole = self.game.record(range(1))
        return type(whole)(whole.t[:20], whole.y[:, :20], whole.u[:, :20], whole.prior)

    @cached_property
    def log(self) -> bytes:
        """A sensor log of 20 samples."""
        pairs = zip(self.record.t.tolist(), self.record.y[0, :, 0].tolist(), strict=True)
        return ("t,y1\n" + "".join(f"{t!r},{y!r}\n" for t, y in pairs)).encode()

    @cached_property
    def log_file(self) -> Path:
        """The same as a file."""
        path = self.file("good_log.csv")
        path.write_bytes(self.log)
        return path

    @cached_property
    def reference(self) -> bytes:
        """The states of that log."""
        lines = (f"{t!r},1.0,0.5,3.0\n" for t in self.record.t.tolist())
        return ("t,x1,x2,x3\n" + "".join(lines)).encode()

    @cached_property
    def rows_file(self) -> Path:
        """A rows file of two episodes, with curves beside it."""
        path = self.file("good") / "rows.jsonl"
        evaluate("open_loop", self.game.name.env_id, episodes=2, results=path)
        return path

    @cached_property
    def trained(self) -> bytes:
        """A file of weights that ships with the package."""
        published = manifest.Manifest.read(manifest.FOLDER)
        if published is None:
            raise ValueError(f"nothing is published in {manifest.FOLDER}; expected trained files")
        (entry,) = (
            each
            for each in published.trained
            if each.trainer == "pinn_gain" and each.env_id == self.game.name.env_id
        )
        return published.content(entry)

    @cached_property
    def trainer(self) -> Any:
        """A trainer after its first iteration."""
        config = TRAINERS.resolve("kkl_supervised").configured(SMALL_TRAINING)
        trainer = trainer_of("kkl_supervised", config, self.game)
        trainer.step()
        return trainer

    @cached_property
    def checkpoint(self) -> bytes:
        """Its checkpoint."""
        path = self.file("good.checkpoint.pt")
        save_checkpoint(self.trainer, path)
        return path.read_bytes()

    @cached_property
    def live(self) -> bytes:
        """A saved live filter after five samples."""
        live = Live(self.filter)
        for k in range(5):
            live.update(self.record.t[k], self.record.y[0, k])
        path = self.file("good.live")
        live.save(path)
        return path.read_bytes()

    @cached_property
    def filter(self) -> EKF:
        """The estimator of that live filter."""
        return EKF.for_setup(self.game.source.system, self.game.source.setup)

    @cached_property
    def records(self) -> Path:
        """A folder of records for other languages."""
        folder = self.file("records")
        issue = Issue(self.game, range(2))
        write_folder(folder, issue, {})
        return folder

    @cached_property
    def estimates(self) -> bytes:
        """Estimates of these records."""
        lines = (self.records / "records.csv").read_text().splitlines()[1:]
        cells = (line.split(",")[:2] for line in lines)
        text = "".join(f"{episode},{t},0.1,0.2,3.0\n" for episode, t in cells)
        return ("episode,t,x1,x2,x3\n" + text).encode()


def digest(value: Any) -> str:
    """Return a hash of nested arrays and values, by which two are compared."""
    return hashlib.sha256(repr(_plain(value)).encode()).hexdigest()


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {repr(name): _plain(part) for name, part in value.items()}
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    if hasattr(value, "detach"):
        value = value.detach().numpy()
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else repr(value)
