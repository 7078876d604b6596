"""Nonlinear state estimation as Gymnasium environments, with estimators and a leaderboard.

Importing this package registers the env ids, one per system: ``pinnobs/ReverseDuffing-v0`` and so
on. It does not import torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

from pinnobs_gym.estimator import Estimator
from pinnobs_gym.system import Setup, System
from pinnobs_gym.systems import SYSTEMS

if TYPE_CHECKING:
    from pinnobs_gym.evaluation import evaluate

__all__ = ["Estimator", "Setup", "System", "env_id", "evaluate", "register"]


def env_id(system: str | type[System]) -> str:
    """The env id of a system, given by class, name or ``module:Class``, which is then registered.

    Raises:
        ValueError: listing the known systems, if it is unknown.
    """
    cls = SYSTEMS.resolve(system)
    register(cls)
    return _id(cls)


def _id(cls: type[System]) -> str:
    return f"pinnobs/{cls.__name__}-v{cls.version}"


def register(cls: type) -> type:
    """Make a system or an estimator of your own known by its name; usable as a decorator.

    A `System` becomes an env (``pinnobs/<class name>-v<version>``), and every estimator, trainer
    and command takes it. An `Estimator` is then found by its class attribute ``name``.

    Raises:
        TypeError: in one line, if the class is neither or is not complete.
        ValueError: if its name is taken.
    """
    if isinstance(cls, type) and issubclass(cls, System):
        cls.validate()
        SYSTEMS.register(cls)
        _register_env(cls)
    elif isinstance(cls, type) and issubclass(cls, Estimator):
        from pinnobs_gym.estimators import ESTIMATORS

        ESTIMATORS.register(cls)
    else:
        raise TypeError(f"{cls!r} is neither a System nor an Estimator")
    return cls


def _register_env(cls: type[System]) -> None:
    name = _id(cls)
    if name not in gymnasium.registry:
        gymnasium.register(
            name,
            entry_point="pinnobs_gym.env:EstimationEnv",
            vector_entry_point="pinnobs_gym.env:EstimationVectorEnv",
            kwargs={"system": cls.__name__},
        )


def __getattr__(name: str) -> Any:
    if name == "evaluate":  # the harness imports more than an env needs
        from pinnobs_gym.evaluation import evaluate

        return evaluate
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


for _cls in SYSTEMS.classes().values():
    _register_env(_cls)
