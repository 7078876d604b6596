"""The environments: a system's episodes, played as single or vectorised Gymnasium envs."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any, Unpack

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from pinnobs_gym.agent_side import AgentSide
from pinnobs_gym.episodes import Ahead, Changes, Episodes, EpisodeSource, Stream
from pinnobs_gym.figures import EpisodePicture
from pinnobs_gym.record import Prior, Record
from pinnobs_gym.system import System

NOT_FINITE_REWARD = -1e4
"""Reward of an action that is not finite; it ends the episode."""


class EstimationEnv(gym.Env[np.ndarray, np.ndarray]):
    """One episode at a time of estimating a plant's state from its noisy outputs.

    `reset` returns the observation of y₀. The action is the estimate x̂(k|k), in physical units; it
    is scored against the true x_k, and time advances. The reward is −mean(((x̂ − x)/scale)²). The
    estimate never acts on the plant. Raw actions are scored, never clipped; one that is not finite
    ends the episode with `NOT_FINITE_REWARD`; otherwise only the time limit ends it. The
    observation after the last action is never scored.

    For agents that learn, ``action_mode`` gives actions another meaning and, with it, observations:
    `pinnobs_gym.actions` has the forms. What they make of an action is then the estimate.

    Args:
        system: name, ``module:Class`` or class of the system.
        setup: ``benchmark`` or ``paper``.
        condition: how episodes depart from the setup; see `pinnobs_gym.conditions`.
        action_mode: ``estimate``, ``normalized``, ``gain`` or ``correction``.
        reward: ``error``, as above, or ``improvement`` on the model's prediction, for training with
            actions that are gains or corrections; see `pinnobs_gym.actions.Gain.improvement`.
        stack_outputs: how many of the last outputs an observation holds.
        render_mode: ``rgb_array`` or ``human``.
        changes: ``dt``, ``duration``, ``noise_std``, ``parameters``; see `Changes`.

    Reset options: ``x0``, the true initial state (nx,), and ``xhat0``, the initial estimate (nx,),
    which is only reported in ``info``. ``info`` holds ``state``, the true state behind the
    observation, for scoring only, and after a reset ``xhat0`` and ``P0``, the prior.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

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
        _check_render_mode(render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.source = EpisodeSource(system, setup, condition, **changes)
        self.agent = AgentSide(self.source, action_mode, reward, stack_outputs)
        self.observation_space = self.agent.form.observation_space
        self.action_space = self.agent.form.action_space
        self._weights = _reward_weights(self.source.system)
        self._num_steps = self.source.setup.num_steps
        self._k = 0
        self._over = True
        self._stream: Stream | None = None
        self._ahead = Ahead(self.source, 1)
        self._picture: EpisodePicture | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        options = _check_options(options, ("x0", "xhat0"))
        prior = Prior.of(self.source.system, self.source.setup, 1, options.get("xhat0"))
        x0 = _given_x0(self.source, options, 1)
        if seed is not None or self._stream is None:
            self._stream = Stream(_seeds_of(self.np_random))
            self._ahead.forget([0])
        episode = self._ahead.take([0], [self._stream], x0)
        self._x, self._observations = episode.x[:, 0], episode.observations[:, 0]
        self._k = 0
        self._over = False
        if self.render_mode is not None:
            self._picture = self._picture or EpisodePicture(self.source.system, self.render_mode)
            self._picture.begin(self.source.times, self._x, self._observations)
        if self.render_mode == "human":
            self.render()
        info = {"state": self._x[0].copy(), "xhat0": prior.mean[0], "P0": prior.cov[0]}
        if self.agent.plain:
            return self._observations[0].copy(), info
        first = self.agent.begin(prior.mean, self._observations[:1], np.zeros(1, dtype=int))
        return first[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        k = self._k
        if self._over:
            raise RuntimeError("the episode is over; call reset before step")
        estimate = np.asarray(action, dtype=float)
        x = self._x[k]
        if not self.agent.plain:
            estimate = self.agent.act(estimate[None])[0]
        elif estimate.shape != x.shape:
            raise ValueError(f"action has shape {estimate.shape}; expected {x.shape}, an estimate")
        with np.errstate(over="ignore", invalid="ignore"):
            error = estimate - x
            reward = -float((error * error).dot(self._weights))
        if self.agent.improves:
            reward = float(self.agent.improvement(estimate[None], x[None])[0])
        terminated = False
        if not math.isfinite(reward):
            terminated = not np.isfinite(estimate).all()
            reward = NOT_FINITE_REWARD if terminated else -sys.float_info.max
        if self._picture is not None:
            self._picture.add(k, estimate)
        self._k = k + 1
        truncated = self._k == self._num_steps
        info = {"state": self._x[self._k].copy()}
        observation = self._observations[self._k].copy()
        if not self.agent.plain:
            observation = self.agent.look(observation[None], np.array([self._k]))[0]
        self._over = terminated or truncated
        if self.render_mode == "human":
            self.render()
        return observation, reward, terminated, truncated, info

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The true states so far over their estimates: an image (height, width, 3), or a window."""
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


class EstimationVectorEnv(gym.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many episodes at a time of what `EstimationEnv` plays one at a time.

    Row i of an env seeded s is the single env seeded s + i. A row whose episode is over is reset by
    the next step, whose action it ignores (Gymnasium's ``NEXT_STEP``). The arguments are those of
    `EstimationEnv`; reset options ``x0`` and ``xhat0`` are (nx,) or (num_envs, nx), and
    ``reset_mask`` (num_envs,) names the rows to reset.
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
        if num_envs < 1:
            raise ValueError(f"num_envs={num_envs}; expected at least 1")
        _check_render_mode(render_mode, self.metadata["render_modes"])
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.source = EpisodeSource(system, setup, condition, **changes)
        self.agent = AgentSide(self.source, action_mode, reward, stack_outputs)
        self.single_observation_space = self.agent.form.observation_space
        self.single_action_space = self.agent.form.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._weights = _reward_weights(self.source.system)
        self._num_steps = self.source.setup.num_steps
        self._rows = np.arange(num_envs)
        self._k = np.zeros(num_envs, dtype=int)
        self._over = np.zeros(num_envs, dtype=bool)
        self._any_over = False
        self._together = True
        self._streams: list[Stream] = []
        self._ahead = Ahead(self.source, num_envs)
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
        options = _check_options(options, ("x0", "xhat0", "reset_mask"))
        rows = self._rows
        if "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != bool:
                raise ValueError(f"reset_mask={mask.tolist()}; expected {self.num_envs} booleans")
            rows = np.flatnonzero(mask) if self._episodes is not None else rows
        xhat0 = options.get("xhat0")
        prior = Prior.of(self.source.system, self.source.setup, self.num_envs, xhat0)
        x0 = _given_x0(self.source, options, self.num_envs)
        self._seed(seed, rows)
        self._begin(rows, prior.mean[rows], None if x0 is None else x0[rows])
        observations, infos = self._look()
        if not self.agent.plain:
            observations = self.agent.begin(self._prior.mean, observations, self._k, rows)
        return observations, infos | self._begun(rows)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        if self._episodes is None:
            raise RuntimeError("no episode has begun; call reset before step")
        estimates = np.asarray(actions, dtype=float)
        shape = (self.num_envs, *self.agent.action_shape)
        if estimates.shape != shape:
            kind = f"as action_mode={self.agent.form.name!r} has them"
            raise ValueError(f"actions have shape {estimates.shape}; expected {shape}, {kind}")
        if not self.agent.plain:
            estimates = self.agent.act(estimates)
        over = self._over
        with np.errstate(over="ignore", invalid="ignore"):
            error = estimates - self._state
            rewards = -((error * error) @ self._weights)
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
            over = over.copy()  # beginning anew clears the original
            begun = np.flatnonzero(over)
            default = Prior.of(self.source.system, self.source.setup, len(begun))
            self._begin(begun, default.mean)
            rewards[over] = 0.0
            terminated &= ~over
        truncated = np.asarray(self._k == self._num_steps)
        self._over = terminated | truncated
        self._any_over = bool(self._over.any())
        observations, infos = self._look()
        if not self.agent.plain:
            if begun is not None:
                self.agent.forget(self._prior.mean, begun)
            observations = self.agent.look(observations, self._k)
        if begun is not None:
            infos |= self._begun(begun)
        return observations, rewards, terminated, truncated, infos

    def record(self) -> Record:
        """What an estimator may see of the episodes now playing, from their first sample to that
        of the last action."""
        return self.source.record(self._playing, self._prior.mean)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """An image (height, width, 3) per row."""
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
        """Give these rows their streams, if there is a seed or no stream yet."""
        seeds: list[int | None]
        if isinstance(seed, int | np.integer):
            super().reset(seed=int(seed))
            seeds = [int(seed) + i for i in range(self.num_envs)]
        elif seed is None:
            seeds = [None] * self.num_envs
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"{len(seeds)} seeds; expected {self.num_envs}, one per row")
        if not self._streams:
            self._streams = [Stream(np.random.SeedSequence(s)) for s in seeds]
        elif seed is not None:
            self._ahead.forget(rows.tolist())
            for row in rows:
                self._streams[row] = Stream(np.random.SeedSequence(seeds[row]))

    def _begun(self, rows: np.ndarray) -> dict[str, Any]:
        """The infos of rows whose episode has just begun: their prior."""
        mask = np.zeros(self.num_envs, dtype=bool)
        mask[rows] = True
        mean, cov = self._prior.mean.copy(), self._prior.cov.copy()
        return {"xhat0": mean, "_xhat0": mask, "P0": cov, "_P0": mask.copy()}

    def _begin(self, rows: np.ndarray, xhat0: np.ndarray, x0: np.ndarray | None = None) -> None:
        """Begin the next episode of these rows, from prior means (len(rows), nx)."""
        self._prior.mean[rows] = xhat0
        chosen = rows.tolist()
        if len(rows) == self.num_envs and not self._ahead.any(chosen):
            # Arrays of this size are slow to allocate: those of episodes that are over serve again.
            draws = self.source.draw(self._streams, self._noise)
            self._noise = draws.noise
            self._episodes = self.source.play(draws, x0, self._episodes)
        else:
            new = self._ahead.take(chosen, self._streams, x0)
            for name in ("x", "y", "observations"):
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

    def _look(self) -> tuple[np.ndarray, dict[str, Any]]:
        """The observations and infos of each row's present sample."""
        episodes, k = self._playing, self._k
        if self._together:
            self._state, observations = episodes.x[k[0]], episodes.observations[k[0]].copy()
        else:
            self._state = episodes.x[k, self._rows]
            observations = episodes.observations[k, self._rows]
        everywhere = np.ones(self.num_envs, dtype=bool)
        return observations, {"state": self._state.copy(), "_state": everywhere}


def _reward_weights(system: System) -> np.ndarray:
    """What each squared error counts in minus the reward."""
    return 1 / (np.asarray(system.scale, dtype=float) ** 2 * system.nx)


def _seeds_of(rng: np.random.Generator) -> np.random.SeedSequence:
    """The seeds that Gymnasium made an env's generator from."""
    seeds = rng.bit_generator.seed_seq
    if not isinstance(seeds, np.random.SeedSequence):
        raise TypeError(f"np_random was made from {type(seeds).__name__}; expected SeedSequence")
    return seeds


def _check_render_mode(mode: str | None, known: Sequence[str]) -> None:
    if mode is not None and mode not in known:
        raise ValueError(f"render_mode={mode!r}; expected {' or '.join(known)}")


def _check_options(options: dict[str, Any] | None, known: Sequence[str]) -> dict[str, Any]:
    for name in options or {}:
        if name not in known:
            raise ValueError(f"unknown reset option {name!r}; known are {', '.join(known)}")
    return options or {}


def _given_x0(source: EpisodeSource, options: dict[str, Any], batch: int) -> np.ndarray | None:
    """The initial states (batch, nx) among the reset options, if there; a warning if they are
    outside the setup's set."""
    if "x0" not in options:
        return None
    nx = source.system.nx
    x0 = np.asarray(options["x0"], dtype=float)
    if x0.shape not in ((nx,), (batch, nx)):
        raise ValueError(f"x0 has shape {x0.shape}; expected ({nx},)")
    if not np.isfinite(x0).all():
        raise ValueError(f"x0={x0.tolist()} is not finite")
    if not np.all(source.contains(x0)):
        name = type(source.system).__name__
        gym.logger.warn(f"x0={x0.tolist()} is outside the initial set of {name}")
    return np.broadcast_to(x0, (batch, nx)).copy()
