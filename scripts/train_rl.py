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
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import tyro

from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimation.learned.trained_file import check_same
from pinnobs_gym.estimators.sb3 import Sb3
from pinnobs_gym.files import check_writable
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training import by_name
from pinnobs_gym.training.log import Log
from trainers.rl import Config


@dataclass(frozen=True)
class Main:
    """Train agents and score them."""

    system: str = "ReverseDuffing"
    """Name or module:Class of a system, or ``all``."""
    seeds: int = 1
    """Agents of each system, of the config's seed and those after it."""
    episodes: int = 100
    """Episodes that each is scored on."""
    config: Annotated[Config, tyro.conf.OmitArgPrefixes] = field(default_factory=Config)
    """The recipe."""
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
            for seed in range(self.config.seed, self.config.seed + self.seeds):
                config = replace(self.config, seed=seed)
                label = f"{config.algorithm} {config.action_mode}, seed {seed}"
                self._score(name, self._trained(name, config), label)

    def _trained(self, name: str, config: Config) -> Estimator:
        """The agent, trained unless its file is there."""
        game = Game.of(name)
        title = f"{game.name.system}-{config.algorithm}-{config.action_mode}"
        path = self.out / f"{title}-seed{config.seed}.pt"
        if not path.exists():
            checkpoint = path.with_suffix(".checkpoint.zip")
            with Log(self.out / "tensorboard" / path.stem) as log:
                trained = by_name.train(
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
        check_same(path, made.trained.config, asdict(config.filled()))
        return made

    def _score(self, name: str, estimator: Estimator | str, label: str) -> None:
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
