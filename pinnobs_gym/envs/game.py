"""A game: a system's setup under a condition."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple, Protocol, Self, Unpack

import gymnasium as gym
import numpy as np

from pinnobs_gym.envs.episodes import Changes, Episodes, EpisodeSource
from pinnobs_gym.envs.registration import env_id
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.files import file_name
from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.conditions import canonical_name
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import Setup, System


class GameName(NamedTuple):
    """The name of a game, as stored in rows."""

    env_id: str
    """Such as ``pinnobs/ReverseDuffing-v0``."""
    setup: str
    """``benchmark`` or ``paper``, or another setup of the system."""
    condition: str
    """Canonical name of the condition; see `pinnobs_gym.simulation.conditions.canonical_name`."""

    @property
    def system(self) -> str:
        """The env id without its namespace."""
        return self.env_id.removeprefix("pinnobs/")

    @property
    def file_stem(self) -> str:
        """The name as the beginning of file names."""
        return "-".join(map(file_name, (self.system, self.setup, self.condition)))


class GivenModel(Protocol):
    """What estimators are given of a game beside its records."""

    @property
    def system(self) -> System:
        """The model."""
        ...

    @property
    def setup(self) -> Setup:
        """The setup: noise, prior and transient window."""
        ...


class AnyGame(Protocol):
    """What scored episodes are of: a `Game` that is simulated, or sensor logs of one model
    (`pinnobs_gym.scoring.log_game.LogGame`)."""

    @property
    def name(self) -> GameName:
        """The name in rows."""
        ...

    @property
    def source(self) -> GivenModel:
        """The model and the setup that estimators are given."""
        ...

    @property
    def nominal(self) -> AnyGame:
        """The game under which estimators are trained."""
        ...


@dataclass(frozen=True)
class Game:
    """A game: all that defines an episode except its seed. Created by `Game.of`.

    A game can be pickled; its episode source is created again when it is unpickled and used.
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
        """Return the game of a system, setup and condition.

        Args:
            system: name, ``module:Class``, class or env id of the system, which is registered.
            setup: the setup's name.
            condition: change of the episodes relative to the setup, such as ``noise5+dropout10``.
            changes: values that replace the setup's: ``dt``, ``duration``, ``noise_std``,
                ``parameters``.

        Raises:
            ValueError: in one line, if one of them is unknown, or they are incompatible.
        """
        if isinstance(system, str) and system.startswith("pinnobs/"):
            name, spec = system, _system_of(system)
            env_id(spec)
        else:
            name = env_id(system)
            spec = _system_of(name)
        game = cls(GameName(name, setup, canonical_name(condition)), spec, dict(changes))
        _ = game.source  # reject incompatible arguments now
        return game

    def __reduce__(self) -> tuple[Any, ...]:
        return Game, (self.name, self.system, self.changes)

    @property
    def source(self) -> EpisodeSource:
        """The source of the episodes, with the model and the setup that estimators are given."""
        return self._source

    @cached_property
    def _source(self) -> EpisodeSource:
        return EpisodeSource(self.system, self.name.setup, self.name.condition, **self.changes)

    @property
    def nominal(self) -> Self:
        """The same game without its condition, under which estimators are trained."""
        return type(self)(self.name._replace(condition="nominal"), self.system, self.changes)

    def episodes(self, seeds: Iterable[int], x0: np.ndarray | None = None) -> Episodes:
        """Return the first episodes of single envs that are reset with these seeds.

        Args:
            seeds: one per episode.
            x0: initial states (nx,) or (batch, nx) that replace the drawn ones.

        Raises:
            ValueError: in one line, if a seed is not a whole number of at least 0, the episodes are
                too many for one batch, or initial states are of the wrong shape or not finite.
        """
        draws = self.source.draw(self.source.streams(seeds))
        if x0 is not None:
            x0 = np.broadcast_to(self.source.given_states(x0, len(draws.x0)), draws.x0.shape)
        return self.source.play(draws, x0)

    def record(self, seeds: Iterable[int]) -> Record:
        """Return the record, given to estimators, of the episodes of these seeds."""
        return self.source.record(self.episodes(seeds))

    def vector_env(self, num_envs: int, **arguments: Any) -> EstimationVectorEnv:
        """Return the vectorised env of the game; ``arguments`` are passed to it, such as
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
    """Return the system of an env id as ``module:Class``."""
    if name not in gym.registry:
        known = sorted(each for each in gym.registry if each.startswith("pinnobs/"))
        guess = did_you_mean(name, known)
        raise ValueError(f"unknown env id {name!r}; known are {', '.join(known)}{guess}")
    return gym.registry[name].kwargs["system"]
