"""The agent of Stable-Baselines3 (SB3), its env, and the layers of its policy."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import nn

from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.sb3_env import Sb3VecEnv
from pinnobs_gym.estimators.sb3 import Layer
from trainers.rl.config import RLConfig

SEEDS_APART = 1000
"""Offset between the first episode seeds of agents trained with consecutive seeds."""
LAST_RATE = 0.02
"""Final learning rate over the initial one."""


def make_agent(config: RLConfig, env: VecNormalize) -> BaseAlgorithm:
    """Create an untrained SB3 agent for an env.

    Raises:
        ValueError: in one line, if the algorithm is recurrent_ppo and sb3-contrib is not installed.
    """
    shape: Any = env.action_space.shape
    policy = "MlpLstmPolicy" if config.algorithm == "recurrent_ppo" else "MlpPolicy"
    chosen = options(config, shape[0])
    return _algorithm(config)(policy, env, seed=config.seed, device="cpu", **chosen)


def make_env(config: RLConfig, game: Game, episode: int) -> VecNormalize:
    """Create the vector env, with seeds from ``episode`` on and normalised observations."""
    learns_gain = config.action_mode != "normalized"
    rows = game.vector_env(
        config.rows,
        action_mode=config.action_mode,
        stack_outputs=config.stack,
        reward="improvement" if learns_gain else "error",
    )
    env = Sb3VecEnv(rows, spread=True)
    env.seed(first_seed(config, episode))
    return VecNormalize(VecMonitor(env), norm_reward=not learns_gain, gamma=config.gamma)


def first_seed(config: RLConfig, episode: int) -> int:
    """Return the seed of the first episode that an agent plays."""
    return episode + SEEDS_APART * config.seed


def learning_rate(config: RLConfig, done: float) -> float:
    """Return Adam's learning rate when a fraction ``done`` of the training is finished."""
    return config.learning_rate * (1 - done * (1 - LAST_RATE))


def _algorithm(config: RLConfig) -> Any:
    """Return the SB3 class of the config's algorithm."""
    if config.algorithm != "recurrent_ppo":
        return getattr(stable_baselines3, config.algorithm.upper())
    try:
        return importlib.import_module("sb3_contrib").RecurrentPPO
    except ImportError:
        raise ValueError(
            "algorithm='recurrent_ppo' needs sb3-contrib: pip install 'pinnobs-gym[rl]'"
        ) from None


def options(config: RLConfig, actions: int) -> dict[str, Any]:
    """Return the keyword arguments of the SB3 class, for actions of ``actions`` components."""
    c: Any = config
    policy: dict[str, Any] = {"net_arch": [c.width, c.width], "activation_fn": nn.Tanh}
    common = {"learning_rate": c.learning_rate, "batch_size": c.batch, "gamma": c.gamma}
    if c.algorithm in ("ppo", "recurrent_ppo"):
        policy["log_std_init"] = c.log_std
        if c.algorithm == "recurrent_ppo":
            policy["lstm_hidden_size"] = c.width
        rollout = {"n_steps": c.rollout, "n_epochs": c.epochs, "gae_lambda": 0.0}
        return {**common, **rollout, "policy_kwargs": policy}
    schedule = {"train_freq": c.rollout, "gradient_steps": c.epochs, "buffer_size": c.buffer}
    off_policy = {**common, **schedule, "tau": 0.02, "learning_starts": 5000}
    if c.algorithm == "td3":
        spread = np.full(actions, math.exp(c.log_std))
        noise = NormalActionNoise(np.zeros(actions), spread)
        return {**off_policy, "policy_kwargs": policy, "action_noise": noise}
    policy["log_std_init"] = c.log_std
    return {**off_policy, "policy_kwargs": policy}


def policy_layers(policy: Any) -> tuple[tuple[Layer, ...], bool, tuple[Layer, Layer] | None]:
    """Return the layers of an SB3 policy, whether it squashes actions, and its recurrent layer."""
    if not isinstance(policy, ActorCriticPolicy):  # off-policy
        actor = policy.actor
        parts = [actor.mu] if isinstance(actor.mu, nn.Sequential) else [actor.latent_pi, actor.mu]
        return _linear(parts), True, None
    layers = _linear([policy.mlp_extractor.policy_net, policy.action_net])
    lstm = getattr(policy, "lstm_actor", None)
    if lstm is None:
        return layers, False, None
    W, V, b, c = (_array(p) for p in lstm._flat_weights)
    return layers, False, ((W, b), (V, c))


def _linear(parts: Sequence[nn.Module]) -> tuple[Layer, ...]:
    layers = [m for part in parts for m in part.modules() if isinstance(m, nn.Linear)]
    return tuple((_array(m.weight), _array(m.bias)) for m in layers)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(float)
