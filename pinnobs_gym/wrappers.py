"""Wrappers that give a single env's actions and observations another form.

``gym.make(id, action_mode="gain")`` is the same as ``GainAction(gym.make(id))``, and vectorised
envs take ``action_mode``, too; the wrappers are for tools that build an env from a list of them.
"""

from __future__ import annotations

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np

from pinnobs_gym.agent_side import AgentSide
from pinnobs_gym.env import EstimationEnv


class _Wrapper(gym.Wrapper[np.ndarray, np.ndarray, np.ndarray, np.ndarray]):
    """An env whose agent acts and observes in a form of `pinnobs_gym.actions`.

    Args:
        env: an `EstimationEnv` whose actions are estimates, at most wrapped in what leaves actions
            and observations alone.
        reward: ``error`` or ``improvement``; see `EstimationEnv`.
    """

    action_mode: ClassVar[str]

    def __init__(self, env: gym.Env, reward: str = "error", *, stack: int = 1) -> None:
        super().__init__(env)
        inner = env.unwrapped
        if not isinstance(inner, EstimationEnv):
            raise ValueError(f"{type(self).__name__} wraps an EstimationEnv; this is {inner!r}")
        if env.observation_space != inner.observation_space or not inner.agent.plain:
            raise ValueError(
                f"{type(self).__name__} wraps an env of action_mode='estimate' that nothing else "
                f"has changed; this one observes {env.observation_space}"
            )
        self._inner = inner
        self._agent = AgentSide(inner.source, self.action_mode, reward, stack)
        self.observation_space = self._agent.form.observation_space
        self.action_space = self._agent.form.action_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        observation, info = self.env.reset(seed=seed, options=options)
        self._k, self._x = 0, info["state"]
        mean = np.asarray(info["xhat0"])[None]
        return self._agent.begin(mean, observation[None], np.array([0]))[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        estimate = self._agent.act(np.asarray(action, dtype=float)[None])
        observation, reward, terminated, truncated, info = self.env.step(estimate[0])
        if self._agent.improves and not terminated:
            reward = float(self._agent.improvement(estimate, self._x[None])[0])
        self._k, self._x = self._k + 1, info["state"]
        observation = self._agent.look(observation[None], np.array([self._k]))[0]
        return observation, float(reward), terminated, truncated, info


class GainAction(_Wrapper):
    """The action is an observer gain; see `pinnobs_gym.actions.Gain`."""

    action_mode = "gain"


class CorrectionAction(_Wrapper):
    """The action corrects the model's prediction; see `pinnobs_gym.actions.Correction`."""

    action_mode = "correction"


class NormalizedEstimate(_Wrapper):
    """The action is the estimate over the largest states to expect, in [−1, 1].

    Args:
        env: as in `GainAction`.
        stack: how many of the last outputs an observation holds.
    """

    action_mode = "normalized"

    def __init__(self, env: gym.Env, stack: int = 1) -> None:
        super().__init__(env, stack=stack)


class StackOutputs(_Wrapper):
    """The observation holds the last n outputs, newest first, zero before the first; the action
    stays the estimate in physical units.

    Args:
        env: as in `GainAction`.
        n: how many.
    """

    action_mode = "estimate"

    def __init__(self, env: gym.Env, n: int) -> None:
        super().__init__(env, stack=n)
