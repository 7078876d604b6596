"""Agents trained by reinforcement learning with Stable-Baselines3.

The agent plays episodes of the env and is rewarded by how near its estimates are to the true
states, which no other trainer of ours sees. With gains and corrections the reward is the
``improvement`` on the model's prediction, and the discount is zero, so that learning a gain is a
regression of the prediction's error on the innovation: what Kalman's gain is.
"""

from __future__ import annotations

import time
from pathlib import Path

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.sb3 import TrainedAgent
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training.log import SILENT, Log
from pinnobs_gym.training.loop import bar, interruption
from trainers.rl.config import Config

__all__ = ["Config", "train"]


def train(
    system: System,
    config: Config,
    *,
    game: Game,
    seed: int,
    log: Log = SILENT,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: bool = False,
) -> TrainedAgent:
    """Train an agent on episodes that it plays itself.

    The agent of the least error on episodes held out is kept. Ctrl-C ends training early and keeps
    it as well. On a CPU the same seed gives the same agent.

    Args:
        system: the model.
        config: the recipe.
        game: what is played.
        seed: of the first episode; no one is scored on these.
        log: where curves go, in SB3's own layout.
        checkpoint: a file to keep SB3's agent in, written again as training goes on; its
            normalisation lies beside it, ending in ``.vecnormalize.pkl``, and the best agent so
            far, ending in ``.best.pt``. The first two are SB3's own formats, which can hold code:
            resume your own files only.
        resume: go on from that file, with new episodes; replay buffers are filled anew.
        progress: show a bar in the terminal.

    Raises:
        ValueError: in one line, if settings do not fit each other, recurrent_ppo is wanted without
            sb3-contrib, or the checkpoint or its normalisation is missing or damaged, or of another
            system, algorithm, action mode or major version of SB3.
    """
    # Everything that looks for estimators imports this module: SB3 is only loaded where it is used.
    from stable_baselines3.common.logger import Logger, configure

    from trainers.rl.agent import begin, restore
    from trainers.rl.watch import Watch

    if resume and checkpoint is None:
        raise ValueError("resume=True without a checkpoint; name its file")
    config = config.filled()
    begun = time.process_time()
    if resume and checkpoint is not None:
        training = restore(system, config, game, seed, checkpoint)
    else:
        training = begin(system, config, game, seed)
    model = training.model
    folder = log.folder
    model.set_logger(
        Logger(None, []) if folder is None else configure(str(folder), ["tensorboard"])
    )
    assert config.rows is not None
    assert config.rollout is not None
    rollout = config.rows * config.rollout
    whole = max(1, config.steps // rollout) * rollout  # SB3 would round up
    left = whole - model.num_timesteps
    with bar(config.steps if progress else None) as show, interruption() as stopped:
        watch = Watch(training, begun, checkpoint, show, stopped)
        try:
            if left > 0:
                model.learn(left, callback=watch, reset_num_timesteps=not model.num_timesteps)
        except KeyboardInterrupt:  # the second, amid a step
            pass
    best = watch.result()
    log.hparams(
        {"system": best.system, **best.config},
        {"end/held_out": best.loss, "end/steps": float(best.iterations)},
    )
    return best
