"""How a system becomes an env id, and an id an env."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium as gym

from pinnobs_gym.systems import SYSTEMS

if TYPE_CHECKING:
    from pinnobs_gym.envs.vector_env import EstimationVectorEnv
    from pinnobs_gym.simulation.record import Record
    from pinnobs_gym.simulation.system import Setup, System


def register_system(cls: type[System]) -> None:
    """Make a system known by its name, and its env to Gymnasium.

    Raises:
        TypeError: in one line, if the class is not complete.
        ValueError: if its name is taken.
    """
    cls.validate()
    SYSTEMS.register(cls)
    _register_env(_id(cls), f"{cls.__module__}:{cls.__qualname__}")


def register_envs() -> None:
    """Make an env of every system known to Gymnasium: of this package, without importing any, and
    of the installed packages that announce some."""
    for name, origin in SYSTEMS.sources.items():
        version = origin.constants.get("version", 0)
        _register_env(f"pinnobs/{name}-v{version}", f"{origin.module}:{name}")
    for cls in SYSTEMS.plug_ins():
        register_system(cls)


def env_id(system: str | type[System]) -> str:
    """The env id of a system, given by class, name or ``module:Class``, which is then registered.

    Raises:
        ValueError: listing the known systems, if it is unknown.
    """
    cls = SYSTEMS.resolve(system)
    register_system(cls)
    return _id(cls)


def _id(cls: type[System]) -> str:
    return f"pinnobs/{cls.__name__}-v{cls.version}"


def _register_env(name: str, system: str) -> None:
    if name not in gym.registry:
        gym.register(
            name,
            entry_point="pinnobs_gym.envs.env:EstimationEnv",
            vector_entry_point="pinnobs_gym.envs.vector_env:EstimationVectorEnv",
            kwargs={"system": system},  # with its module, so that a new process finds it
        )


def make_vector_env(
    env_id: str, num_envs: int, setup: str, condition: str, **changes: Any
) -> EstimationVectorEnv:
    """The vectorised env of that id; ``changes`` are further settings of it, such as noise_std.

    Raises:
        ValueError: listing the valid ids, if it is unknown.
    """
    known = [name for name in gym.registry if name.startswith("pinnobs/")]
    if env_id not in known:
        raise ValueError(f"unknown env id {env_id!r}; known are {', '.join(sorted(known))}")
    env: Any = gym.make_vec(
        env_id,
        num_envs,
        vectorization_mode="vector_entry_point",
        setup=setup,
        condition=condition,
        **changes,
    ).unwrapped
    return env


def record_of(
    name: str, setup: str, condition: str, seed: int, episodes: int = 1
) -> tuple[System, Setup, Record]:
    """An env's model, what estimators are told of the setup, and the record of its episodes of the
    seeds from seed on."""
    env = make_vector_env(name, episodes, setup, condition)
    env.reset(seed=seed)
    return env.source.system, env.source.setup, env.record()
