"""Video of an episode: an env's frames while an estimator plays it."""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.files import check_writable, replacing

FPS = 30.0
"""Largest number of frames per second."""
SHORTEST, LONGEST = 5.0, 20.0
"""Limits of a video's duration in s; shorter episodes are slowed down, longer ones sped up."""


@dataclass(frozen=True)
class Pace:
    """The pace of a video."""

    stride: int
    """Samples per frame."""
    fps: float
    """Frames per second, at most `FPS`."""

    @classmethod
    def of(cls, duration: float, dt: float) -> Pace:
        """Return real time, or the pace that keeps the duration between `SHORTEST` and
        `LONGEST`."""
        speed = duration / min(max(duration, SHORTEST), LONGEST)
        stride = max(1, math.ceil(speed / (FPS * dt) - 1e-9))
        return cls(stride, speed / (stride * dt))


def check_video(path: Path) -> None:
    """Check before the work that a video can be written.

    Raises:
        ValueError: in one line, if the suffix is not ``.mp4``, moviepy is missing, or the path
            cannot be written.
    """
    if path.suffix != ".mp4":
        raise ValueError(f"video {path}; expected a name that ends in .mp4")
    _recorder()
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder")
    check_writable(path.parent)


def write_video(path: Path, estimator: BaseEstimator, game: Game, seed: int) -> Pace:
    """Write the video of an episode from its first sample to its last, which is shown for one more
    second. An existing file is replaced once the new one is complete.

    Args:
        path: the file.
        estimator: its estimates are the actions.
        game: what is played.
        seed: of the episode.

    Raises:
        ValueError: in one line, if the file cannot be written.
    """
    save_video = _recorder()
    pace = Pace.of(game.source.setup.duration, game.source.setup.dt)
    actions = estimator.run(game.record([seed])).xhat[0]
    name, setup, condition = game.name
    drawn = gym.make(name, setup=setup, condition=condition, render_mode="rgb_array")
    drawn.reset(seed=seed)
    frames = [drawn.render()]
    for k, action in enumerate(actions, 1):
        _, _, terminated, truncated, _ = drawn.step(action)
        over = terminated or truncated  # an estimate that is not finite ends it early
        if over or k % pace.stride == 0:
            frames.append(drawn.render())
        if over:
            break
    drawn.close()
    frames += frames[-1:] * round(pace.fps)
    with (
        replacing(path) as temporary,
        tempfile.TemporaryDirectory(prefix=".video", dir=path.parent) as folder,
    ):
        # save_video chooses the file's name.
        save_video(frames, folder, episode_trigger=lambda _: True, fps=pace.fps)
        (written,) = Path(folder).iterdir()
        os.replace(written, temporary)
    return pace


def _recorder() -> Any:
    """Return Gymnasium's function that writes frames as a video."""
    try:
        from gymnasium.utils.save_video import save_video
    except gym.error.DependencyNotInstalled:
        raise ValueError(
            'a video needs moviepy; install it with pip install "pinnobs-gym[video]"'
        ) from None
    return save_video
