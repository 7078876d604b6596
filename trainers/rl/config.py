"""Settings and presets of the trainer of agents."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from pinnobs_gym.training.settings import TrainingConfig, check_setting, check_whole

Algorithm: TypeAlias = Literal["ppo", "sac", "td3", "recurrent_ppo"]
"""Algorithm of Stable-Baselines3 or, for ``recurrent_ppo``, sb3-contrib."""
Mode: TypeAlias = Literal["gain", "correction", "normalized"]
"""Action mode of the env."""

_ON_POLICY = ("ppo", "recurrent_ppo")


@dataclass(frozen=True)
class RLConfig(TrainingConfig):
    """Settings of the training of an agent; by default PPO with gains as actions.

    The defaults were tuned for PPO with gains, on episodes that are not scored; the other presets
    are derived from them.
    """

    may_change = (
        *("steps", "rows", "learning_rate", "rollout", "batch", "epochs", "gamma", "log_std"),
        *("buffer", "held_out", "check_every"),
    )

    algorithm: Algorithm = "ppo"
    """The algorithm, see the preset of its name; recurrent_ppo needs the extra ``rl``."""
    action_mode: Mode = "gain"
    """Meaning of the agent's actions; see `pinnobs_gym.envs.actions`."""
    steps: int = 300_000
    """Largest number of training steps over all rows, rounded down to whole rollouts."""
    rows: int = 64
    """Number of episodes that are played in parallel."""
    learning_rate: float = 1e-3
    """Initial step size of Adam, which decays linearly to nearly zero."""
    rollout: int = 64
    """Steps of each row between updates of the agent, that is, per iteration."""
    batch: int = 512
    """Mini-batch size of a gradient."""
    epochs: int = 10
    """Passes through a rollout's samples; off-policy, gradient steps after each rollout."""
    gamma: float = 0.0
    """Discount factor; with 0 an action is judged by the error at its own sample alone."""
    width: int = 32
    """Neurons in each of the two hidden layers, and in the recurrent layer."""
    log_std: float = -1.0
    """Logarithm of the exploration noise's initial standard deviation (td3: constant)."""
    buffer: int = 0
    """Size of the replay buffer of off-policy algorithms; 0 on-policy."""
    stack: int = 1
    """Number of the latest outputs that are observed, with ``normalized``."""
    held_out: int = 32
    """Number of episodes held out for validation."""
    check_every: int = 30_000
    """Steps between validations."""
    checkpoint_every: int = 8
    """Iterations between checkpoints."""
    log_every: int = 1
    """Iterations between points of the logged curves."""

    @property
    def records(self) -> int:
        return 0

    def __post_init__(self) -> None:
        self.check_shared()
        whole = ("steps", "rows", "rollout", "batch", "epochs", "width", "stack")
        check_whole(self, (*whole, "held_out", "check_every"))
        check_setting(self, "learning_rate", "a positive number", lambda v: 0 < v < math.inf)
        check_setting(self, "gamma", "a number from 0 to 1", lambda v: 0 <= v <= 1)
        check_setting(self, "log_std", "a finite number", math.isfinite)
        if self.action_mode != "normalized":
            check_setting(self, "stack", "1, since there is a prediction", lambda v: v == 1)
        hint = f"with {self.algorithm}; the preset {self.algorithm} sets all related settings"
        if self.algorithm in _ON_POLICY:
            check_setting(self, "buffer", f"0 {hint}", lambda v: v == 0)
            samples = self.rows * self.rollout
            expected = f"a divisor of rows·rollout = {samples}"
            check_setting(self, "batch", expected, lambda v: v > 1 and samples % v == 0)
        else:
            check_setting(
                self, "buffer", f"a positive whole number {hint}", lambda v: v == int(v) > 0
            )


def ppo() -> RLConfig:
    """Proximal policy optimisation (Schulman et al. 2017) with gains as actions."""
    return RLConfig()


def sac() -> RLConfig:
    """Soft actor-critic (Haarnoja et al. 2018) with gains as actions."""
    return RLConfig(
        algorithm="sac",
        rows=32,
        rollout=4,
        epochs=4,
        buffer=300_000,
        checkpoint_every=250,
        log_every=10,
    )


def td3() -> RLConfig:
    """Twin delayed deep deterministic policy gradient (TD3, Fujimoto et al. 2018) with gains as
    actions."""
    return replace(sac(), algorithm="td3")


def recurrent_ppo() -> RLConfig:
    """PPO with a long short-term memory and gains as actions; needs the extra ``rl``."""
    return RLConfig(algorithm="recurrent_ppo")


def ppo_normalized() -> RLConfig:
    """PPO with estimates as actions, which observes the latest outputs."""
    return replace(ppo(), action_mode="normalized", stack=8, width=64)


def sac_normalized() -> RLConfig:
    """Soft actor-critic with estimates as actions, which observes the latest outputs."""
    return replace(sac(), action_mode="normalized", stack=8, width=64)


def td3_normalized() -> RLConfig:
    """TD3 with estimates as actions, which observes the latest outputs."""
    return replace(td3(), action_mode="normalized", stack=8, width=64)


def recurrent_ppo_normalized() -> RLConfig:
    """PPO with a long short-term memory and estimates as actions."""
    return replace(recurrent_ppo(), action_mode="normalized", width=64)


PRESETS = {
    made.__name__: made
    for made in (
        *(ppo, sac, td3, recurrent_ppo),
        *(ppo_normalized, sac_normalized, td3_normalized, recurrent_ppo_normalized),
    )
}
