"""Train PPO with the default settings of Stable-Baselines3 in several action modes, and score it.

    python scripts/default_ppo.py --system ReverseDuffing

A line of each: the median NRMSE of whole episodes and of their last quarters, and how many
diverged, of the episodes of seeds 0 to 99, beside those of the EKF.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
import torch
import tyro
from stable_baselines3 import PPO

from pinnobs_gym import evaluate
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.scoring.rows import Row

MODES: tuple[dict[str, Any], ...] = (
    {},
    {"action_mode": "normalized"},
    {"action_mode": "gain"},
    {"action_mode": "gain", "reward": "improvement"},
)
"""Arguments of the envs in which an agent is trained."""


@dataclass(frozen=True)
class Main:
    """Train and score."""

    system: str = "ReverseDuffing"
    """Name of the system."""
    steps: int = 100_000
    """Number of steps of each training."""
    seed: int = 0
    """Seed of the agents."""

    def run(self) -> None:
        """Print a line of each agent."""
        name = env_id(self.system)
        _print("ekf", evaluate("ekf", name), 0.0)
        for arguments in MODES:
            begun = time.process_time()
            env: Any = gym.make(name, **arguments)
            agent = PPO("MlpPolicy", env, seed=self.seed, device="cpu")
            agent.learn(self.steps)
            label = ", ".join(arguments.values()) or "default"
            _print(label, evaluate(agent, name), time.process_time() - begun)


def _print(label: str, rows: list[Row], seconds: float) -> None:
    whole, tail = (np.array([row[name] for row in rows]) for name in ("nrmse", "nrmse_tail"))
    diverged = np.mean([row["diverged"] for row in rows])
    print(
        f"{label:20} NRMSE {np.median(whole):8.4g}, last quarter {np.median(tail):8.4g}, "
        f"diverged {100 * diverged:3.0f} %, {seconds:.0f} CPU s",
        flush=True,
    )


if __name__ == "__main__":
    torch.set_num_threads(1)
    try:
        tyro.cli(Main).run()
    except ValueError as error:
        sys.exit(f"default_ppo: error: {error}")
