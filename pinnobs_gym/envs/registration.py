"""Registration of systems as env ids."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium as gym

from pinnobs_gym.systems import SYSTEMS

if TYPE_CHECKING:
    from pinnobs_gym.simulation.system import System


def register_system(cls: type[System]) -> None:
    """Register a system by its name, and its env with Gymnasium.

    Raises:
        TypeError: in one line, if the class is incomplete.
        ValueError: if its name is taken.
    """
    cls.validate()
    SYSTEMS.register(cls)
    _register_env(_id(cls), f"{cls.__module__}:{cls.__qualname__}", cls.reward_threshold)


def register_envs() -> None:
    """Register an env of every system with Gymnasium: of this package, without importing the
    systems, and of installed plug-ins."""
    for name, origin in SYSTEMS.sources.items():
        version = origin.constants.get("version", 0)
        threshold = origin.constants.get("reward_threshold")
        _register_env(f"pinnobs/{name}-v{version}", f"{origin.module}:{name}", threshold)
    for cls in SYSTEMS.plug_ins():
        register_system(cls)


def env_id(system: str | type[System]) -> str:
    """Return the env id of a system, given by class, name or ``module:Class``, and register the
    system.

    Raises:
        ValueError: listing the known systems, if it is unknown.
        TypeError: in one line, if the class is incomplete or one of its functions fails
            (`pinnobs_gym.simulation.probe.probe`).
    """
    from pinnobs_gym.simulation.probe import probe  # it imports the systems' base class

    cls = SYSTEMS.resolve(system)
    register_system(cls)
    probe(cls)
    return _id(cls)


def _id(cls: type[System]) -> str:
    return f"pinnobs/{cls.__name__}-v{cls.version}"


def _register_env(name: str, system: str, threshold: float | None) -> None:
    if name not in gym.registry:
        gym.register(
            name,
            entry_point="pinnobs_gym.envs.env:EstimationEnv",
            vector_entry_point="pinnobs_gym.envs.vector_env:EstimationVectorEnv",
            reward_threshold=threshold,
            kwargs={"system": system},  # the module allows a new process to import it
        )
