"""The vectorised env with the interface of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from pinnobs_gym.envs.vector_env import EstimationVectorEnv


class Sb3VecEnv(VecEnv):
    """An `EstimationVectorEnv` as a `VecEnv` of Stable-Baselines3.

    A row whose episode is over starts its next one in the same step, as SB3 expects; its info then
    holds ``terminal_observation`` and ``TimeLimit.truncated``. Infos hold nothing else, so that
    agents do not get the true states. `seed` seeds the episodes that start with the next reset, row
    i with seed + i.

    Args:
        env: the env; its autoreset is not used.
        spread: shorten episodes, so that a batch of rows has samples from all times of an episode,
            and more from the transient. Of n rows, those with an even index i play whole episodes
            except the first, which ends after the fraction s = (i+1)/n; those with an odd index end
            every episode after the fraction s².
    """

    def __init__(self, env: EstimationVectorEnv, *, spread: bool = False) -> None:
        self.env = env
        self._spread = spread
        self._actions: np.ndarray | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> np.ndarray:
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        options = {name: value for given in self._options for name, value in given.items()}
        if any(given != self._options[0] for given in self._options):
            raise ValueError(
                f"reset options differ between rows: {self._options}; give one for all"
            )
        observations, _ = self.env.reset(seed=seeds, options=options)
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        last = self.env.source.setup.num_steps
        part = np.arange(1, self.num_envs + 1) / self.num_envs
        early = np.arange(self.num_envs) % 2 == 1
        first = np.where(early, part**2, part) if self._spread else np.ones(self.num_envs)
        later = np.where(early, part**2, 1.0) if self._spread else first
        self._cut, self._later = (np.ceil(p * last).astype(int) for p in (first, later))
        self._steps = np.zeros(self.num_envs, dtype=int)
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        assert self._actions is not None
        observations, rewards, terminated, truncated, _ = self.env.step(self._actions)
        self._steps += 1
        truncated = truncated | (self._steps == self._cut)
        over = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over.any():
            for i in np.flatnonzero(over):
                infos[i] = {
                    "terminal_observation": observations[i].copy(),
                    "TimeLimit.truncated": bool(truncated[i] and not terminated[i]),
                }
            observations, _ = self.env.reset(options={"reset_mask": over})
            self._steps[over] = 0
            self._cut[over] = self._later[over]
        return observations, rewards.astype(np.float32), over, infos

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        if len(list(self._get_indices(indices))) != self.num_envs:
            raise ValueError(f"{attr_name} belongs to all rows at once; leave indices out")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of the vectorised env once; its result is returned for every requested
        row."""
        value = getattr(self.env, method_name)(*method_args, **kwargs)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(
        self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None
    ) -> list[bool]:
        """Return False for every row: action modes replace the wrappers of single envs."""
        return [False for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        return self.env.render() or [None] * self.num_envs
