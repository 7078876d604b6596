"""Every estimator that is trained, after a training that is done in a moment."""

import functools
from dataclasses import replace

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.training.by_name import train_by_name

KKL = {"trajectories": 80, "samples": 40, "iterations": 20, "width": 10, "patience": 1.0}
GAIN = {"episodes": 10, "held_out": 3, "width": 6, "iterations": 3, "streams": 6, "chunk": 10}
AGENT = {"steps": 256, "rows": 4, "rollout": 16, "batch": 32, "epochs": 2, "width": 8}
BANK = {
    **{"iterations": 4, "per_condition": 2, "near": 2, "wide": 2},
    **{"noise_levels": (0.1,), "deviation": (0.1,)},
}
QUICK = {
    "kkl_autoencoder": KKL,
    "kkl_pinn": KKL,
    "kkl_supervised": KKL,
    "pinn_gain": GAIN,
    "pinn_obs": {"depth": 2, "width": 8, "iterations": 3},
    "robust_gain": BANK,
    "rl": {**AGENT, "held_out": 4, "action_mode": "correction"},
}
"""Settings by which each trainer is done in a moment."""


@functools.cache
def made(name):
    """An estimator after a training that taught it little."""
    cls, game = ESTIMATORS.resolve(name), Game.of("ReverseDuffing")
    system, setup = game.source.system, game.source.setup
    trainer = cls.needs_training or cls.trains_on_record
    config = TRAINERS.resolve(trainer).configured({**cls.recipe, **QUICK[trainer]})
    if cls.needs_training is None:
        return replace(cls.for_setup(system, setup), config=config)
    return cls.for_setup(system, setup, trained=train_by_name(trainer, config, game))
