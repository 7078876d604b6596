"""Train agents with Stable-Baselines3, and score them beside the EKF and the open-loop model.

    python scripts/train_rl.py --system ReverseDuffing
    python scripts/train_rl.py --system all --seeds 3 --budget 600

Each agent is trained on episodes with seeds from 1,000,000 on, and scored on those with seeds 0 to
99. Trained files, checkpoints, rows and TensorBoard logs go to one folder. If it is stopped, the
same command resumes it.
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
    """Number of agents per system, with consecutive seeds."""
    episodes: int = 100
    """Number of episodes on which each agent is scored."""
    algorithm: str = "ppo"
    """Preset of the trainer, such as ppo, sac or ppo_normalized."""
    seed: int = 0
    """Seed of the first agent."""
    steps: int = 300_000
    """Number of steps of each training."""
    budget: float | None = None
    """CPU seconds of each training."""
    out: Path = Path("runs/rl")
    """Folder of the output."""

    def run(self) -> None:
        """Train and score all agents, and print a line for each."""
        check_writable(self.out)
        names = list(SYSTEMS.classes()) if self.system == "all" else [self.system]
        print(f"{'system':20} {'estimator':22} {'tail NRMSE':>10} {'NRMSE':>10} {'diverged':>9}")
        for name in names:
            for peer in ("open_loop", "ekf"):
                self._score(name, peer, peer)
            for seed in range(self.seed, self.seed + self.seeds):
                self._score(name, self._trained(name, seed), f"{self.algorithm}, seed {seed}")

    def _trained(self, name: str, seed: int) -> BaseEstimator:
        """Load an agent, after training it if its file does not exist."""
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
            if trained.ending == "interrupted":  # an interrupted training is not a result
                raise KeyboardInterrupt
            trained.save(path)
        estimator = Sb3.load(path, game.source.system)
        check_same(path, estimator.trained.config, plain(asdict(config)))
        return estimator

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
        sys.exit("train_rl: stopped; the same command resumes it")
