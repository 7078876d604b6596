"""The single environment."""

from __future__ import annotations

import math
import sys
from typing import Any, Unpack

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.agent_side import AgentSide
from pinnobs_gym.envs.arguments import (
    NOT_FINITE_REWARD,
    action_array,
    check_arguments,
    check_options,
    check_render_mode,
    errors_of,
    given_prior,
    given_x0,
    reward_weights,
    seeds_of,
)
from pinnobs_gym.envs.episode_buffer import EpisodeBuffer
from pinnobs_gym.envs.episodes import Changes, EpisodeSource, Stream
from pinnobs_gym.envs.figures import EpisodePicture, Metadata
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import check_seed


class EstimationEnv(gym.Env[np.ndarray, np.ndarray]):
    """Estimation of a plant's state from its noisy outputs, one episode at a time.

    `reset` returns the observation of y₀. The action is the estimate x̂(k|k) in physical units. It
    is scored against the true x_k, and time advances. The reward is −mean(((x̂ − x)/scale)²). The
    estimate never acts on the plant. Actions are scored unclipped. An action that is not finite
    ends the episode with `NOT_FINITE_REWARD`; otherwise only the time limit ends it. The
    observation after the last action is never scored.

    An observation is the outputs, the inputs and t/T. Under a condition that loses outputs, the
    latest present value stands for a missing output (zero before the first), and a mask follows
    the outputs: 1 for each that is present, 0 for each that is missing.

    For learning agents, ``action_mode`` selects other actions and observations;
    `pinnobs_gym.envs.actions` has the forms. The estimate is then computed from the action by the
    form.

    Args:
        system: name, ``module:Class`` or class of the system.
        setup: ``benchmark`` or ``paper``.
        condition: change of the episodes relative to the setup; see
            `pinnobs_gym.simulation.conditions`.
        action_mode: ``estimate``, ``normalized``, ``gain`` or ``correction``.
        reward: ``error``, as above, or ``improvement`` over the model's prediction, for training
            with actions that are gains or corrections; see
            `pinnobs_gym.envs.actions.PredictionForm.improvement`.
        stack_outputs: number of the last outputs in an observation.
        render_mode: ``rgb_array`` or ``human``.
        changes: ``dt``, ``duration``, ``noise_std``, ``parameters``; see `Changes`.

    Reset options: ``x0``, the true initial state (nx,), and ``xhat0``, the initial estimate (nx,),
    from which forms with a prediction start. ``info`` holds ``state``, the true state at the
    observation, for scoring only, and after a reset ``xhat0`` and ``P0``, the prior.
    """

    metadata = Metadata()  # pyright: ignore[reportAssignmentType]

    def __init__(
        self,
        system: str | type[System],
        setup: str = "benchmark",
        condition: str = "nominal",
        *,
        action_mode: str = "estimate",
        reward: str = "error",
        stack_outputs: int = 1,
        render_mode: str | None = None,
        **changes: Unpack[Changes],
    ) -> None:
        check_arguments(type(self), changes)
        check_render_mode(render_mode, type(self).metadata["render_modes"])
        self.render_mode = render_mode
        self.source = EpisodeSource(system, setup, condition, **changes)
        self.agent = AgentSide(self.source, action_mode, reward, stack_outputs)
        self.observation_space = self.agent.form.observation_space
        self.action_space = self.agent.form.action_space
        self._weights = reward_weights(self.source.system).tolist()
        self._error = errors_of(self.source.system)
        self._num_steps = self.source.setup.num_steps
        self._k = 0
        self._over = True
        self._stream: Stream | None = None
        self._buffer = EpisodeBuffer(self.source, 1, measured=False)
        self._picture: EpisodePicture | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        seed = None if seed is None else check_seed(seed)
        options = check_options(options, ("x0", "xhat0"))
        prior = given_prior(self.source, options, 1)
        x0 = given_x0(self.source, options, 1)
        super().reset(seed=seed)
        if seed is not None or self._stream is None:
            self._stream = self.source.stream(seeds_of(self.np_random))
            self._buffer.forget([0])
        episode = self._buffer.take([0], [self._stream], x0)
        self._x, self._observations = episode.x[:, 0], episode.observations[:, 0]
        self._state = self._x[0]
        self._k = 0
        self._over = False
        if self.render_mode is not None:
            self._picture = self._picture or EpisodePicture(self.source.system, self.render_mode)
            self._picture.begin(self.source.times, self._x, self._observations)
        if self.render_mode == "human":
            self.render()
        info = {"state": self._state.copy(), "xhat0": prior.mean[0], "P0": prior.cov[0]}
        if self.agent.plain:
            return self._observations[0].copy(), info
        first = self.agent.begin(prior.mean, self._observations[:1], np.zeros(1, dtype=int))
        return first[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k = self._k
        if self._over:
            raise RuntimeError("the episode is over; call reset before step")
        estimate = action_array(action)
        x = self._state
        if not self.agent.plain:
            estimate = self.agent.act(estimate[None])[0]
        elif estimate.shape != x.shape:
            raise ValueError(f"action has shape {estimate.shape}; expected {x.shape}, an estimate")
        if self.agent.improves:
            reward = float(self.agent.improvement(estimate[None], x[None])[0])
        else:
            reward = 0.0
            for error, weight in zip(self._error(estimate, x).tolist(), self._weights, strict=True):
                reward -= error * error * weight  # of few numbers, faster than in arrays
        terminated = False
        if not math.isfinite(reward):
            terminated = not np.isfinite(estimate).all()
            reward = NOT_FINITE_REWARD if terminated else -sys.float_info.max
        if self._picture is not None:
            self._picture.add(k, estimate)
        self._k = k + 1
        truncated = self._k == self._num_steps
        self._state = self._x[self._k]
        observation = self._observations[self._k].copy()
        if not self.agent.plain:
            observation = self.agent.observe(observation[None], np.array([self._k]))[0]
        self._over = terminated or truncated
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, truncated, {"state": self._state.copy()}

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the true states so far with their estimates: an image (height, width, 3), or a
        window."""
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing: make the env with render_mode='rgb_array'")
            return None
        if self._picture is None:
            raise RuntimeError("there is nothing to draw yet; call reset before render")
        return self._picture.draw(self._k)

    def close(self) -> None:
        if self._picture is not None:
            self._picture.close()
            self._picture = None
