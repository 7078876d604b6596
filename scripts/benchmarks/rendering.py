"""Frames of a single env."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import gymnasium as gym
import numpy as np

from benchmarks import Figure, at_least, cpu_seconds
from pinnobs_gym.systems import SYSTEMS

FRAMES = 50
"""Number of frames that are drawn at the end of an episode, where its curves are longest."""


def figures(repeats: int) -> Iterator[Figure]:
    """Measure the frames per CPU-second with ``render_mode="rgb_array"``, with a step per frame."""
    for name in SYSTEMS.classes():
        fps = float(np.median([FRAMES / cpu_seconds(last_frames(name)) for _ in range(repeats)]))
        yield at_least(f"rgb_array, {name}, steps with a frame per CPU-second", fps, "1/s", 30.0)


def last_frames(name: str) -> Callable[[], None]:
    """Play an episode up to its last frames; return a function that plays and draws these."""
    env = gym.make(f"pinnobs/{name}-v0", render_mode="rgb_array")
    _, info = env.reset(seed=0)
    env.render()  # the first frame of an episode draws the fixed parts
    estimate = info["xhat0"].astype(np.float32)
    num_steps = SYSTEMS.resolve(name).setups["benchmark"].num_steps
    for _ in range(num_steps - FRAMES):
        env.step(estimate)

    def draw() -> None:
        for _ in range(FRAMES):
            env.step(estimate)
            env.render()

    return draw
