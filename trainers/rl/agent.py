"""SB3's agent and its env: how they begin, are saved, and become what an estimator loads."""

from __future__ import annotations

import importlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch import nn

from pinnobs_gym.envs.game import Game
from pinnobs_gym.envs.sb3_env import Sb3VecEnv
from pinnobs_gym.estimation.learned.trained_file import check_same, identity
from pinnobs_gym.estimators.sb3 import Layer, TrainedAgent, setup_of
from pinnobs_gym.simulation.system import System
from trainers.rl.config import Config

SEEDS_APART = 1000
"""From the first seed of an agent's episodes to that of the agent trained with the next seed."""
RESUMED = 10**9
"""From these first seeds to those of episodes that are played after a resumption."""
LAST_RATE = 0.02
"""The learning rate in the end, over that at first."""
FACTS = "pinnobs"
"""The attribute of SB3's agent that says what it was trained on, in its file."""


@dataclass
class Training:
    """An agent in training."""

    system: System
    config: Config
    game: Game
    seed: int
    """Of the first episode."""
    model: BaseAlgorithm
    env: VecNormalize
    earlier: float = 0.0
    """CPU seconds before a resumption."""
    best: TrainedAgent | None = None
    """The best agent so far."""

    def agent(self, loss: float, seconds: float) -> TrainedAgent:
        """What an estimator needs of the agent as it is now."""
        model: Any = self.model
        source = self.env.get_attr("source")[0]
        layers, squash, recurrent = _layers(model.policy)
        statistics: Any = self.env.obs_rms
        about = identity(self.system)
        assert self.config.stack is not None
        return TrainedAgent(
            layers=layers,
            recurrent=recurrent,
            normalization=(statistics.mean.copy(), statistics.var.copy()),
            clip=float(self.env.clip_obs),
            activation="tanh",
            squash=squash,
            algorithm=self.config.algorithm,
            action_mode=self.config.action_mode,
            stack=self.config.stack,
            setup=setup_of(source.setup),
            system=about["system"],
            parameters=about["parameters"],
            config=asdict(self.config),
            sb3=stable_baselines3.__version__,
            loss=loss,
            iterations=model.num_timesteps,
            seconds=seconds,
        )

    def save(self, checkpoint: Path, seconds: float) -> None:
        """Write SB3's agent, its normalisation and the best agent so far."""
        setattr(
            self.model, FACTS, json.dumps(_facts(self.system, self.config) | {"seconds": seconds})
        )
        parts = _beside(checkpoint)
        checkpoint.parent.mkdir(parents=True, exist_ok=True)
        temporary = checkpoint.with_name(checkpoint.name + ".part")
        with temporary.open("wb") as file:
            self.model.save(file)
        self.env.save(str(parts["normalization"]) + ".part")
        Path(str(parts["normalization"]) + ".part").replace(parts["normalization"])
        if self.best is not None:
            self.best.save(parts["best"])
        temporary.replace(checkpoint)


def begin(system: System, config: Config, game: Game, seed: int) -> Training:
    """An agent that knows nothing, and the env that it is to play."""
    venv = _venv(config, game, seed)
    env = VecNormalize(
        venv, norm_reward=config.action_mode == "normalized", gamma=config.gamma or 0.0
    )
    shape: Any = env.action_space.shape
    policy = "MlpLstmPolicy" if config.algorithm == "recurrent_ppo" else "MlpPolicy"
    chosen = options(config, shape[0])
    model = _algorithm(config)(policy, env, seed=config.seed, device="cpu", **chosen)
    return Training(system, config, game, seed, model, env)


def restore(system: System, config: Config, game: Game, seed: int, checkpoint: Path) -> Training:
    """The agent in a checkpoint, to be trained further.

    Raises:
        ValueError: in one line, if a file is missing or damaged, or belongs to something else.
    """
    parts = _beside(checkpoint)
    for what, path in (("checkpoint", checkpoint), ("normalisation", parts["normalization"])):
        if not path.exists():
            raise ValueError(f"cannot resume: the {what} file {path} is missing")
    try:
        model = _algorithm(config).load(checkpoint, device="cpu")
        facts = json.loads(getattr(model, FACTS))
    except Exception as error:  # SB3 raises many kinds for a file it does not understand
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"{checkpoint} is damaged or no checkpoint of {config.algorithm}: {reason}"
        ) from None
    check_same(checkpoint, facts, _facts(system, config))
    # Other episodes than those played so far: the state of the env is not in the checkpoint.
    venv = _venv(config, game, seed + RESUMED + model.num_timesteps)
    try:
        env = VecNormalize.load(str(parts["normalization"]), venv)
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(f"{parts['normalization']} is damaged: {reason}") from None
    model.set_env(env)
    best = TrainedAgent.load(parts["best"], system) if parts["best"].exists() else None
    return Training(system, config, game, seed, model, env, facts["seconds"], best)


def _venv(config: Config, game: Game, seed: int) -> VecMonitor:
    """The rows that are played, of seeds from this one on."""
    assert config.rows is not None
    learns_gain = config.action_mode != "normalized"
    env = game.vector_env(
        config.rows,
        action_mode=config.action_mode,
        stack_outputs=config.stack,
        reward="improvement" if learns_gain else "error",
    )
    venv = Sb3VecEnv(env, spread=True)
    venv.seed(seed + SEEDS_APART * config.seed)
    return VecMonitor(venv)


def _algorithm(config: Config) -> Any:
    """SB3's class."""
    if config.algorithm != "recurrent_ppo":
        return getattr(stable_baselines3, config.algorithm.upper())
    try:
        return importlib.import_module("sb3_contrib").RecurrentPPO
    except ImportError:
        raise ValueError(
            "algorithm='recurrent_ppo' needs sb3-contrib: pip install 'pinnobs-gym[rl]'"
        ) from None


def options(config: Config, actions: int) -> dict[str, Any]:
    """A config in SB3's words, for actions of so many numbers."""
    c: Any = config
    policy: dict[str, Any] = {"net_arch": [c.width, c.width], "activation_fn": nn.Tanh}
    rate = LinearSchedule(c.learning_rate, LAST_RATE * c.learning_rate, 1.0)
    common = {"learning_rate": rate, "batch_size": c.batch, "gamma": c.gamma}
    if c.algorithm in ("ppo", "recurrent_ppo"):
        policy["log_std_init"] = c.log_std
        if c.algorithm == "recurrent_ppo":
            policy["lstm_hidden_size"] = c.width
        rollout = {"n_steps": c.rollout, "n_epochs": c.epochs, "gae_lambda": 0.0}
        return {**common, **rollout, "policy_kwargs": policy}
    kept = {"train_freq": c.rollout, "gradient_steps": c.epochs, "buffer_size": c.buffer}
    found = {**common, **kept, "tau": 0.02, "learning_starts": 5000}
    if c.algorithm == "td3":
        spread = np.full(actions, math.exp(c.log_std))
        noise = NormalActionNoise(np.zeros(actions), spread)
        return {**found, "policy_kwargs": policy, "action_noise": noise}
    policy["log_std_init"] = c.log_std
    return {**found, "policy_kwargs": policy}


def _layers(policy: Any) -> tuple[tuple[Layer, ...], bool, tuple[Layer, Layer] | None]:
    """The layers of SB3's policy, whether its action is squashed, and its recurrent layer."""
    if not hasattr(policy, "mlp_extractor"):  # off-policy
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
    found = [m for part in parts for m in part.modules() if isinstance(m, nn.Linear)]
    return tuple((_array(m.weight), _array(m.bias)) for m in found)


def _array(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().numpy().astype(float)


def _facts(system: System, config: Config) -> dict[str, Any]:
    """What a checkpoint must agree with."""
    about = {n: identity(system)[n] for n in ("system", "parameters")}
    about |= {n: getattr(config, n) for n in ("algorithm", "action_mode", "stack", "width", "seed")}
    major = stable_baselines3.__version__.partition(".")[0]
    return {**about, "major version of stable-baselines3": major}


def _beside(checkpoint: Path) -> dict[str, Path]:
    """The files beside a checkpoint."""
    endings = {"normalization": ".vecnormalize.pkl", "best": ".best.pt"}
    return {n: checkpoint.with_name(checkpoint.name + e) for n, e in endings.items()}
