"""What is played: a system's setup under a condition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Self, Unpack

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.episodes import Changes, Episodes, EpisodeSource, Stream
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.simulation.conditions import canonical_name
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System


class GameName(NamedTuple):
    """What was played, as rows name it."""

    env_id: str
    """Such as ``pinnobs/ReverseDuffing-v0``."""
    setup: str
    """``benchmark`` or ``paper``, or another of the system's."""
    condition: str
    """Its canonical name; see `pinnobs_gym.simulation.conditions.canonical_name`."""

    @property
    def system(self) -> str:
        """The env id without its namespace."""
        return self.env_id.removeprefix("pinnobs/")

    @property
    def file_stem(self) -> str:
        """The name as the beginning of a file's."""
        return "-".join([self.system, self.setup, self.condition])


@dataclass(frozen=True)
class Game:
    """What is played: everything that makes an episode but its seed. Made by `Game.of`.

    A game can be pickled; its episodes are made anew wherever it arrives.
    """

    name: GameName
    system: str
    """``module:Class`` of the system."""
    changes: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """Values that replace those of the setup; see `pinnobs_gym.envs.episodes.Changes`."""

    @classmethod
    def of(
        cls,
        system: str | type[System],
        setup: str = "benchmark",
        condition: str = "nominal",
        **changes: Unpack[Changes],
    ) -> Self:
        """The game of a system, setup and condition.

        Args:
            system: name, ``module:Class``, class or env id of the system, which is registered.
            setup: the setup's name.
            condition: how episodes depart from the setup, such as ``noise5+dropout10``.
            changes: values that replace the setup's: ``dt``, ``duration``, ``noise_std``,
                ``parameters``.

        Raises:
            ValueError: in one line, if one of them is unknown, or they do not fit each other.
        """
        if isinstance(system, str) and system.startswith("pinnobs/"):
            name, spec = system, _system_of(system)
            env_id(spec)
        else:
            name = env_id(system)
            spec = _system_of(name)
        game = cls(GameName(name, setup, canonical_name(condition)), spec, dict(changes))
        _ = game.source  # what does not fit is refused now
        return game

    def __reduce__(self) -> tuple[Any, ...]:
        return Game, (self.name, self.system, self.changes)

    @cached_property
    def source(self) -> EpisodeSource:
        """What makes the episodes; it has the model and the setup that estimators are told."""
        return EpisodeSource(self.system, self.name.setup, self.name.condition, **self.changes)

    def episodes(self, seeds: Iterable[int], x0: np.ndarray | None = None) -> Episodes:
        """The episodes that single envs reset with these seeds begin with.

        Args:
            seeds: one for each episode.
            x0: initial states (batch, nx) that replace those drawn.
        """
        streams = [Stream(np.random.SeedSequence(seed)) for seed in seeds]
        return self.source.play(self.source.draw(streams), x0)

    def record(self, seeds: Iterable[int]) -> Record:
        """What an estimator may see of the episodes of these seeds."""
        return self.source.record(self.episodes(seeds))

    def vector_env(self, num_envs: int, **arguments: Any) -> EstimationVectorEnv:
        """The vectorised env of the game; ``arguments`` are further ones of it, such as
        ``action_mode``."""
        name, setup, condition = self.name
        env: Any = gym.make_vec(
            name,
            num_envs,
            vectorization_mode="vector_entry_point",
            setup=setup,
            condition=condition,
            **self.changes,
            **arguments,
        ).unwrapped
        return env


def _system_of(name: str) -> str:
    """The system of an env id, as ``module:Class``."""
    if name not in gym.registry:
        known = ", ".join(sorted(each for each in gym.registry if each.startswith("pinnobs/")))
        raise ValueError(f"unknown env id {name!r}; known are {known}")
    return gym.registry[name].kwargs["system"]
