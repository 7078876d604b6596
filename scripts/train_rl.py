"""Train agents with Stable-Baselines3 on systems, score them beside the EKF and the model alone.

    python scripts/train_rl.py --system ReverseDuffing
    python scripts/train_rl.py --system all --seeds 3 --budget 600

Each agent is trained on episodes of seeds from 1,000,000 on and scored on those of 0 to 99. Trained
files, checkpoints, rows and TensorBoard's log go to one folder. Stop it at any time; run again, it
goes on.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import sys
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.learned.trained_file import check_same, plain
from pinnobs_gym.estimators.sb3 import Sb3
from pinnobs_gym.files import check_writable
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import train_by_name
from pinnobs_gym.training.log import Log
from trainers.rl import RLTrainer


@dataclass(frozen=True)
class Main:
    """Train agents and score them."""

    system: str = "ReverseDuffing"
    """Name or module:Class of a system, or ``all``."""
    seeds: int = 1
    """Agents of each system, of the first seed and those after it."""
    episodes: int = 100
    """Episodes that each is scored on."""
    algorithm: str = "ppo"
    """Preset of the trainer, such as ppo, sac or ppo_normalized."""
    seed: int = 0
    """Seed of the first agent."""
    steps: int = 300_000
    """Steps of each training."""
    budget: float | None = None
    """CPU seconds of each training."""
    out: Path = Path("runs/rl")
    """Folder of everything that is written."""

    def run(self) -> None:
        """Train and score, printing a line each."""
        check_writable(self.out)
        names = list(SYSTEMS.classes()) if self.system == "all" else [self.system]
        print(f"{'system':20} {'estimator':22} {'tail NRMSE':>10} {'NRMSE':>10} {'diverged':>9}")
        for name in names:
            for peer in ("open_loop", "ekf"):
                self._score(name, peer, peer)
            for seed in range(self.seed, self.seed + self.seeds):
                self._score(name, self._trained(name, seed), f"{self.algorithm}, seed {seed}")

    def _trained(self, name: str, seed: int) -> BaseEstimator:
        """The agent, trained unless its file is there."""
        changes = {"seed": seed, "steps": self.steps, "budget": self.budget}
        config = RLTrainer.configured({"preset": self.algorithm, **changes})
        game = Game.of(name)
        path = self.out / f"{game.name.system}-{self.algorithm}-seed{seed}.pt"
        if not path.exists():
            checkpoint = path.with_suffix(".checkpoint.pt")
            with Log(self.out / "tensorboard" / path.stem) as log:
                trained = train_by_name(
                    "rl",
                    config,
                    game,
                    log=log,
                    checkpoint=checkpoint,
                    resume=checkpoint.exists(),
                    progress=sys.stdout.isatty(),
                )
            trained.save(path)
        made = Sb3.load(path, game.source.system)
        check_same(path, made.trained.config, plain(asdict(config)))
        return made

    def _score(self, name: str, estimator: BaseEstimator | str, label: str) -> None:
        results = self.out / "rows.jsonl"
        rows = evaluate(estimator, env_id(name), episodes=self.episodes, results=results)
        tail, whole = (_median(rows, part) for part in ("nrmse_tail_modulo", "nrmse_modulo"))
        diverged = float(np.mean([row["nrmse_tail_modulo"] > 0.2 for row in rows]))
        print(f"{name:20} {label:22} {tail:10.5f} {whole:10.4f} {diverged:9.2f}", flush=True)


def _median(rows: list[Row], name: str) -> float:
    return float(np.median([row[name] for row in rows]))


if __name__ == "__main__":
    torch.set_num_threads(1)
    try:
        tyro.cli(Main).run()
    except ValueError as error:
        sys.exit(f"train_rl: error: {error}")
    except KeyboardInterrupt:
        sys.exit("train_rl: stopped; run again to go on")
