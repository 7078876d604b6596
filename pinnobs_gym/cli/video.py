"""A video of an episode: the picture that an env draws while an estimator plays it."""

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
from pinnobs_gym.files import check_writable

FPS = 30.0
"""Most frames in a second."""
SHORTEST, LONGEST = 5.0, 20.0
"""How long videos last in s: shorter episodes are slowed down, longer ones sped up."""


@dataclass(frozen=True)
class Pace:
    """How an episode is shown."""

    stride: int
    """Samples from one frame to the next."""
    fps: float
    """Frames in a second, at most `FPS`."""

    @classmethod
    def of(cls, duration: float, dt: float) -> Pace:
        """In real time if the video lasts neither too short nor too long then."""
        speed = duration / min(max(duration, SHORTEST), LONGEST)
        stride = max(1, math.ceil(speed / (FPS * dt) - 1e-9))
        return cls(stride, speed / (stride * dt))


def check_video(path: Path) -> None:
    """Find out whether a video can be written, before the work that it takes.

    Raises:
        ValueError: in one line, if the ending is not ``.mp4``, moviepy is missing, or nothing can
            be written there.
    """
    if path.suffix != ".mp4":
        raise ValueError(f"video {path}; expected a name that ends in .mp4")
    _recorder()
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder")
    check_writable(path.parent)


def write_video(path: Path, estimator: BaseEstimator, game: Game, seed: int) -> Pace:
    """Write the video of an episode, from its first sample to its last, which is held for a second;
    a file that is there is replaced when the new one is whole.

    Args:
        path: the file.
        estimator: whose estimates are the actions.
        game: what is played.
        seed: of the episode.

    Raises:
        ValueError: in one line, if it cannot be written.
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
    try:
        with tempfile.TemporaryDirectory(prefix=".video", dir=path.parent) as folder:
            # It chooses the name itself.
            save_video(frames, folder, episode_trigger=lambda _: True, fps=pace.fps)
            (written,) = Path(folder).iterdir()
            os.replace(written, path)
    except OSError as error:
        raise ValueError(f"cannot write {path}: {' '.join(str(error).split())}") from None
    return pace


def _recorder() -> Any:
    """Gymnasium's function that makes a video of frames."""
    try:
        from gymnasium.utils.save_video import save_video
    except gym.error.DependencyNotInstalled:
        raise ValueError(
            'a video needs moviepy; install it with pip install "pinnobs-gym[video]"'
        ) from None
    return save_video
