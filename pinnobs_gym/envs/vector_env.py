"""The vectorised environment."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any, Unpack

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from pinnobs_gym.envs.agent_side import AgentSide
from pinnobs_gym.envs.arguments import (
    NOT_FINITE_REWARD,
    action_array,
    check_arguments,
    check_num_envs,
    check_options,
    check_render_mode,
    given_prior,
    given_x0,
    masked_rows,
    reward_of,
    reward_weights,
    seeds_of_rows,
)
from pinnobs_gym.envs.episode_buffer import EpisodeBuffer
from pinnobs_gym.envs.episodes import Changes, Episodes, EpisodeSource, Stream
from pinnobs_gym.envs.figures import EpisodePicture
from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System


class EstimationVectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """A vectorised `EstimationEnv`: many episodes at a time.

    Row i of an env with seed s equals the single env with seed s + i. A row whose episode is over
    is reset by the next step, which ignores its action (Gymnasium's ``NEXT_STEP``). The arguments
    are those of `EstimationEnv`. Reset options ``x0`` and ``xhat0`` are (nx,) or (num_envs, nx),
    and ``reset_mask`` (num_envs,) selects the rows to reset.
    """

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": 30,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        num_envs: int,
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
        num_envs = check_num_envs(num_envs)
        check_render_mode(render_mode, self.metadata["render_modes"])
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.source = EpisodeSource(system, setup, condition, **changes)
        self.source.check_batch(num_envs)
        self.agent = AgentSide(self.source, action_mode, reward, stack_outputs)
        self.single_observation_space = self.agent.form.observation_space
        self.single_action_space = self.agent.form.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._weights = reward_weights(self.source.system)
        self._num_steps = self.source.setup.num_steps
        self._rows = np.arange(num_envs)
        self._k = np.zeros(num_envs, dtype=int)
        self._over = np.zeros(num_envs, dtype=bool)
        self._any_over = False
        self._together = True
        self._streams: list[Stream] = []
        self._buffer = EpisodeBuffer(self.source, num_envs, measured=True)
        self._episodes: Episodes | None = None
        self._noise: np.ndarray | None = None
        self._prior = Prior.of(self.source.system, self.source.setup, num_envs)
        self._pictures: list[EpisodePicture] = []

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,  # pyright: ignore
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        options = check_options(options, ("x0", "xhat0", "reset_mask"))
        rows = self._rows
        if "reset_mask" in options:
            chosen = masked_rows(options["reset_mask"], self.num_envs)
            rows = chosen if self._episodes is not None else rows
        prior = given_prior(self.source, options, self.num_envs)
        x0 = given_x0(self.source, options, self.num_envs)
        self._seed(seed, rows)
        self._begin(rows, prior.mean[rows], None if x0 is None else x0[rows])
        observations, infos = self._observe()
        if not self.agent.plain:
            observations = self.agent.begin(self._prior.mean, observations, self._k, rows)
        return observations, infos | self._prior_infos(rows)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self._episodes is None:
            raise RuntimeError("no episode has begun; call reset before step")
        estimates = action_array(actions)
        shape = (self.num_envs, *self.agent.action_shape)
        if estimates.shape != shape:
            kind = f"as action_mode={self.agent.form.name!r} has them"
            raise ValueError(f"actions have shape {estimates.shape}; expected {shape}, {kind}")
        if not self.agent.plain:
            estimates = self.agent.act(estimates)
        over = self._over
        rewards = reward_of(self.source.system, estimates, self._state, self._weights)
        if self.agent.improves:
            rewards = self.agent.improvement(estimates, self._state)
        terminated = np.zeros(self.num_envs, dtype=bool)
        if not math.isfinite(rewards.sum()):
            terminated = np.asarray(~np.isfinite(estimates).all(axis=1))
            rewards = np.where(terminated, NOT_FINITE_REWARD, rewards)
            np.maximum(rewards, -sys.float_info.max, out=rewards)
        for row, picture in enumerate(self._pictures):
            if not over[row]:
                picture.add(int(self._k[row]), estimates[row])
        self._k += 1
        begun = None
        if self._any_over:
            over = over.copy()  # starting new episodes clears the original
            begun = np.flatnonzero(over)
            default = Prior.of(self.source.system, self.source.setup, len(begun))
            self._begin(begun, default.mean)
            rewards[over] = 0.0
            terminated &= ~over
        truncated = np.asarray(self._k == self._num_steps)
        self._over = terminated | truncated
        self._any_over = bool(self._over.any())
        observations, infos = self._observe()
        if not self.agent.plain:
            if begun is not None:
                self.agent.forget(self._prior.mean, begun)
            observations = self.agent.observe(observations, self._k)
        if begun is not None:
            infos |= self._prior_infos(begun)
        return observations, rewards, terminated, truncated, infos

    def record(self) -> Record:
        """Return the record of the current episodes, which estimators are given: the samples up to
        that of the last action."""
        return self.source.record(self._playing, self._prior.mean)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return an image (height, width, 3) per row."""
        if self.render_mode is None:
            gym.logger.warn("render() draws nothing: make the env with render_mode='rgb_array'")
            return None
        drawn = [picture.draw(int(k)) for picture, k in zip(self._pictures, self._k, strict=True)]
        return tuple(image for image in drawn if image is not None)

    def close_extras(self, **kwargs: Any) -> None:
        for picture in self._pictures:
            picture.close()
        self._pictures = []

    @property
    def _playing(self) -> Episodes:
        if self._episodes is None:
            raise RuntimeError("no episode has begun; call reset first")
        return self._episodes

    def _seed(self, seed: int | Sequence[int | None] | None, rows: np.ndarray) -> None:
        """Create the streams of these rows if a seed is given or there are none yet."""
        seeds = seeds_of_rows(seed, self.num_envs)
        if isinstance(seed, int | np.integer):
            super().reset(seed=seeds[0])
        if not self._streams:
            self._streams = self.source.streams(seeds)
        elif seed is not None:
            self._buffer.forget(rows.tolist())
            for row in rows:
                (self._streams[row],) = self.source.streams([seeds[row]])

    def _prior_infos(self, rows: np.ndarray) -> dict[str, Any]:
        """Return the infos of rows whose episode has just started: their prior."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[rows] = True
        mean, cov = self._prior.mean.copy(), self._prior.cov.copy()
        return {"xhat0": mean, "_xhat0": mask, "P0": cov, "_P0": mask.copy()}

    def _begin(self, rows: np.ndarray, xhat0: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Start the next episode of these rows, with prior means (len(rows), nx)."""
        self._prior.mean[rows] = xhat0
        chosen = rows.tolist()
        if len(rows) == self.num_envs and not self._buffer.any(chosen):
            # Large arrays are slow to allocate: reuse those of the finished episodes.
            draws = self.source.draw(self._streams, self._noise)
            self._noise = draws.noise
            self._episodes = self.source.play(draws, x0, self._episodes)
        else:
            new = self._buffer.take(chosen, self._streams, x0)
            for name in ("x", "y", "u", "observations"):
                getattr(self._playing, name)[:, rows] = getattr(new, name)
        self._k[rows] = 0
        self._over[rows] = False
        self._any_over = bool(self._over.any())
        self._together = bool((self._k == self._k[0]).all())
        if self.render_mode is not None:
            if not self._pictures:
                mode = self.render_mode
                self._pictures = [EpisodePicture(self.source.system, mode) for _ in self._rows]
            for row in rows:
                x, observations = self._playing.x[:, row], self._playing.observations[:, row]
                self._pictures[row].begin(self.source.times, x, observations)

    def _observe(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Return the observations and infos of the current sample of each row."""
        episodes, k = self._playing, self._k
        if self._together:
            self._state, observations = episodes.x[k[0]], episodes.observations[k[0]].copy()
        else:
            self._state = episodes.x[k, self._rows]
            observations = episodes.observations[k, self._rows]
        everywhere = np.ones(self.num_envs, dtype=bool)
        return observations, {"state": self._state.copy(), "_state": everywhere}
