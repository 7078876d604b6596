"""Agents trained by reinforcement learning with Stable-Baselines3.

The agent plays episodes of the env. The reward depends on the error of its estimates, and hence on
the true states of simulated episodes. With gains and corrections the reward
is the ``improvement`` on the model's prediction, and the default discount is zero. Learning a gain
is then a regression of the prediction error on the innovation, whose solution is the Kalman gain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import stable_baselines3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from pinnobs_gym.estimation.learned.trained import content_of, from_content
from pinnobs_gym.estimation.learned.trained_file import with_tensors
from pinnobs_gym.estimators.sb3 import Sb3, TrainedAgent, setup_of
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.training.trainer import Trainer
from trainers.rl.agent import first_seed, learning_rate, make_agent, make_env, policy_layers
from trainers.rl.config import PRESETS, RLConfig

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HELD_OUT = 500_000
"""Offset of the first validation seed from the first training seed."""
RESUMED = 10**9
"""Offset of the seeds after a resumption from the first training seed."""
_STATISTICS = ("mean", "var", "count")


class RLTrainer(Trainer[RLConfig, TrainedAgent]):
    """Train an agent on episodes that it plays itself.

    The agent with the least validation loss is kept. The loss is the geometric mean of two medians
    over the held-out episodes: of the NRMSE over the whole episode and over its last quarter, both
    modulo indistinguishable states. A diverged episode counts as infinite. A resumed training
    plays new episodes and starts with an empty replay buffer.
    """

    name = "rl"
    takes = Sb3.takes
    simulates = True
    presets = PRESETS

    def start(self) -> None:
        self.env = make_env(self.config, self.game, self.episode)
        self.agent: Any = make_agent(self.config, self.env)
        self._logged: dict[str, float] = {}
        self.agent.set_logger(Logger(None, [_Values(self._logged)]))
        self.rollout = self.config.rows * self.config.rollout
        self.best: TrainedAgent | None = None
        self.latest = math.nan
        self._validated = 0

    @property
    def steps(self) -> int:
        """Number of steps so far, over all rows."""
        return self.agent.num_timesteps

    @property
    def whole(self) -> int:
        """Total number of steps of the training, in whole rollouts."""
        return max(1, self.config.steps // self.rollout) * self.rollout

    def step(self) -> None:
        """Play one rollout and update the agent."""
        rate = learning_rate(self.config, (self.steps + self.rollout) / self.whole)
        self.agent.lr_schedule = lambda _: rate
        first = not self.steps
        validate = _EachStep(self._validate_if_due)
        self.agent.learn(self.rollout, callback=validate, reset_num_timesteps=first)
        self.iteration += 1

    def _validate_if_due(self) -> None:
        if self.steps - self._validated >= self.config.check_every:
            self._validate()

    def _validate(self) -> None:
        """Compute the agent's validation loss, and keep the agent if it is the best so far."""
        self._validated = self.steps
        estimator = Sb3(
            self.system, tuple(self.noise_std.tolist()), trained=self._trained(math.nan)
        )
        first = self.episode + HELD_OUT
        played = play(self.game, estimator, range(first, first + self.config.held_out))
        scores = played.scores_alone
        parts = ("nrmse_modulo", "nrmse_tail_modulo")
        medians = {part: float(np.median(getattr(scores, part))) for part in parts}
        self.latest = math.sqrt(math.prod(medians.values()))
        if self.best is None or self.latest < self.best.loss:
            self.best = self._trained(self.latest)
        self._logged |= {f"held_out/{name}": value for name, value in medians.items()}
        self._logged["held_out/diverged"] = float(scores.diverged.mean())
        self._logged["held_out/best"] = self.best.loss

    def _trained(self, loss: float) -> TrainedAgent:
        """Return the trained object of the current agent."""
        layers, squash, recurrent = policy_layers(self.agent.policy)
        statistics: Any = self.env.obs_rms
        return TrainedAgent(
            **self.facts(loss=loss, seed=self.config.seed),
            layers=layers,
            recurrent=recurrent,
            normalization=(statistics.mean.copy(), statistics.var.copy()),
            clip=float(self.env.clip_obs),
            activation="tanh",
            squash=squash,
            algorithm=self.config.algorithm,
            action_mode=self.config.action_mode,
            stack=self.config.stack,
            setup=setup_of(self.game.source.system, self.game.source.setup),
            sb3=stable_baselines3.__version__,
            steps=self.steps,
        )

    def finished(self) -> bool:
        return self.steps >= self.whole

    def progress(self) -> float:
        return self.steps / self.whole

    def status(self) -> str:
        best = math.nan if self.best is None else self.best.loss
        return f"{self.steps} steps, held out {self.latest:.4g}, best {best:.4g}"

    def curves(self) -> Mapping[str, float]:
        return self._logged

    def state(self) -> dict[str, Any]:
        names = self.agent._get_torch_save_params()[1]
        statistics = {"features": self.env.obs_rms, "returns": self.env.ret_rms}
        return {
            "steps": self.steps,
            "parameters": self.agent.get_parameters(),
            "variables": {name: getattr(self.agent, name).detach() for name in names},
            "statistics": {
                kind: {name: getattr(each, name) for name in _STATISTICS}
                for kind, each in statistics.items()
            },
            "best": content_of(self.best),
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        self.agent.num_timesteps = self._validated = state["steps"]
        self.agent.set_parameters(with_tensors(state["parameters"]), device="cpu")
        for name, value in with_tensors(state["variables"]).items():
            getattr(self.agent, name).data.copy_(value)
        statistics: Any = self.env.obs_rms, self.env.ret_rms
        for each, kind in zip(statistics, ("features", "returns"), strict=True):
            for name in _STATISTICS:
                setattr(each, name, state["statistics"][kind][name])
        if state["best"] is not None:
            self.best = from_content(TrainedAgent, state["best"])
        # The state of the env is not saved; new seeds avoid repeating the episodes so far.
        self.env.seed(first_seed(self.config, self.episode + RESUMED + self.steps))

    def result(self) -> TrainedAgent:
        """Return the best agent, with the metadata of the whole training."""
        if self.best is None or self._validated != self.steps:
            self._validate()
        assert self.best is not None
        facts = self.facts(loss=self.best.loss, seed=self.config.seed)
        return replace(self.best, **facts, steps=self.steps)

    def figures(self, trained: TrainedAgent) -> dict[str, Figure]:
        return {}


class _EachStep(BaseCallback):
    """Callback that calls a function after each step of the env."""

    def __init__(self, call: Callable[[], None]) -> None:
        super().__init__()
        self._call = call

    def _on_step(self) -> bool:
        self._call()
        return True


class _Values(KVWriter):
    """Writer that keeps the latest numbers logged by SB3."""

    def __init__(self, values: dict[str, float]) -> None:
        self._values = values

    def write(
        self,
        key_values: dict[str, Any],
        key_excluded: dict[str, tuple[str, ...]],
        step: int = 0,
    ) -> None:
        numbers = (int, float, np.number)
        self._values |= {
            name: float(value) for name, value in key_values.items() if isinstance(value, numbers)
        }

    def close(self) -> None:
        """Do nothing; no file is open."""
