"""Speed of envs over whole episodes, the first reset included, against CartPole-v1."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym
from benchmarks import Figure, at_least, median_ratio

from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.systems import SYSTEMS

EPISODES = 5
"""Number of episodes that each row plays."""
ROWS = 1024
"""Number of rows of a vectorised env."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure single and vectorised envs of all systems."""
    for name in SYSTEMS.classes():
        made, steps = env_id(name), SYSTEMS.resolve(name).setups["benchmark"].num_steps
        what = f"over {EPISODES} whole episodes, speed / CartPole-v1's, {name}"
        each = EPISODES * steps

        def single(of: str, count: int = each) -> None:
            play(of, count)

        ratio = median_ratio(lambda: single("CartPole-v1"), lambda m=made: single(m), repeats)
        yield at_least(f"single env {what}", ratio, "x", 1.3)
        each += EPISODES - 1  # the steps that reset rows

        def many(of: str, count: int = each) -> None:
            play_rows(of, count)

        ratio = median_ratio(lambda: many("CartPole-v1"), lambda m=made: many(m), repeats)
        asked = 0.4 if name == "InductionMotor" else 1.0
        yield at_least(f"env of {ROWS} rows {what}", ratio, "x", asked)


def play(made: str, steps: int) -> None:
    """Make an env, and play this number of steps."""
    env = gym.make(made)
    env.action_space.seed(0)
    action = env.action_space.sample()
    env.reset(seed=0)
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()


def play_rows(made: str, steps: int) -> None:
    """Make a vectorised env, and play this number of steps."""
    env = gym.make_vec(made, ROWS, vectorization_mode="vector_entry_point")
    env.action_space.seed(0)
    actions = env.action_space.sample()
    env.reset(seed=0)
    for _ in range(steps):
        env.step(actions)
