"""Agents of Stable-Baselines3: how fast they train, and their scores beside the EKF's."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks import Figure, at_least, at_most, median_ratio
from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.envs.sb3_env import Sb3VecEnv
from pinnobs_gym.estimators.sb3 import Sb3, TrainedAgent
from pinnobs_gym.leaderboard.grid import markdown_table
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import train_by_name
from trainers.rl import RLConfig

SEEDS = 3
"""Number of training seeds."""
EPISODES = 100
"""Number of episodes, with seeds 0, 1, ..."""
DUFFING = "ReverseDuffing"
FRAMES = 16_384
"""Number of steps of a rollout, and of a measurement."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the speed, then the training and scores, system by system."""
    yield from speed(repeats)
    near = []
    for name in SYSTEMS.classes():
        open_loop, ekf = (tail(evaluate(e, env_id(name))) for e in ("open_loop", "ekf"))
        ratios = []
        for seed in range(SEEDS):
            trained = trained_on(name, seed)
            value = tail(scores(name, trained))
            ratios.append(value / ekf)
            about = f"{name}, seed {seed}"
            own = name == DUFFING
            yield Figure(f"tail NRMSE of the gain agent, {about}", value, "", "", None)
            yield limited(f"over the EKF's {ekf:.4g}, {about}", ratios[-1], 5.0 if own else None)
            over = value / open_loop
            yield limited(
                f"over the model alone's {open_loop:.4g}, {about}", over, 0.1 if own else None
            )
            yield at_most(f"steps of training, {about}", trained.steps, "", 300_000)
            yield at_most(f"training, {about}", trained.seconds, "CPU s", 600.0)
            if own and not seed:
                yield reproduced(name, trained)
        near.append(float(np.median(ratios)) <= 10)
    what = f"systems where the median of {SEEDS} seeds is at most 10 times the EKF's"
    yield at_least(what, sum(near), "", 4)


def readme_table(lines: Sequence[dict[str, Any]]) -> str:
    """Return the table of the agents' tail NRMSE over the EKF's, by system and seed."""
    values = {line["figure"]: line["value"] for line in lines}
    table = []
    for name in SYSTEMS.classes():
        tails = [
            _of(values, f"tail NRMSE of the gain agent, {name}, seed {s}") for s in range(SEEDS)
        ]
        over = [_of(values, "over the EKF's", f", {name}, seed {s}") for s in range(SEEDS)]
        cost = [_of(values, f"training, {name}, seed {s}") for s in range(SEEDS)]
        table.append(
            (
                name,
                *(f"{tail:.3g}" for tail in tails),
                " / ".join(f"{ratio:.2g}" for ratio in over),
                f"{np.median(cost):.0f}",
            )
        )
    what = (
        "**Agents.** PPO with gain actions, at most 300,000 steps, three training seeds: median "
        f"tail NRMSE of {EPISODES} benchmark episodes, that over the EKF's, CPU s of training."
    )
    seeds = (f"seed {seed}" for seed in range(SEEDS))
    return f"{what}\n\n{markdown_table(('system', *seeds, '/ EKF', 'training s'), table)}"


def _of(values: dict[str, float], start: str, end: str = "") -> float:
    return next(
        (v for name, v in values.items() if name.startswith(start) and name.endswith(end)), np.nan
    )


def trained_on(name: str, seed: int) -> Any:
    """Train an agent with the default settings."""
    return train_by_name("rl", RLConfig(seed=seed), Game.of(name))


def scores(name: str, trained: TrainedAgent) -> list[Row]:
    """Return the rows of an agent's episodes."""
    system = SYSTEMS.resolve(name)()
    estimator = Sb3(system, trained.setup["noise_std"], trained=trained)
    return evaluate(estimator, env_id(name), episodes=EPISODES)


def tail(rows: list[Row]) -> float:
    """Return the median tail NRMSE over episodes, modulo indistinguishable states."""
    return float(np.median([row["nrmse_tail_modulo"] for row in rows]))


def limited(figure: str, value: float, bound: float | None) -> Figure:
    """Return a figure with an upper bound, or without a bound."""
    return (
        Figure(figure, value, "x", "", None)
        if bound is None
        else at_most(figure, value, "x", bound)
    )


def reproduced(name: str, trained: TrainedAgent) -> Figure:
    """Measure the largest difference in any score between an agent and its reloaded copy."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "agent.pt"
        trained.save(path)
        again = TrainedAgent.load(path, SYSTEMS.resolve(name)())
    pairs = zip(scores(name, trained), scores(name, again), strict=True)
    largest = max(abs(a["nrmse"] - b["nrmse"]) for a, b in pairs)
    return at_most(f"scores of the agent - of its file, {name}", largest, "", 0.0)


def speed(repeats: int) -> Iterator[Figure]:
    """Compare the speed of PPO with gains on 256 rows through the adapter, and on 8 single envs.

    Both have the same steps per rollout, gradients and network.
    """
    name = env_id(DUFFING)
    arguments: dict[str, Any] = {"action_mode": "gain", "reward": "improvement"}

    def own() -> VecEnv:
        return Sb3VecEnv(Game.of(DUFFING).vector_env(256, **arguments))

    def peer() -> VecEnv:
        return DummyVecEnv([lambda: gym.make(name, **arguments) for _ in range(8)])

    for label, epochs, asked in (("default PPO", 10, 3.0), ("one epoch", 1, None)):
        ratio = median_ratio(learner(peer(), epochs), learner(own(), epochs), repeats)
        what = f"frames per CPU-second, adapter at 256 rows / DummyVecEnv with 8 envs, {label}"
        yield at_least(what, ratio, "x", asked)


def learner(env: VecEnv, epochs: int) -> Callable[[], object]:
    """Return a function that trains an agent for one rollout."""
    steps = FRAMES // env.num_envs
    model = PPO("MlpPolicy", env, n_steps=steps, batch_size=512, n_epochs=epochs, device="cpu")
    return lambda: model.learn(FRAMES)
