"""Nonlinear state estimation as Gymnasium environments, with estimators and a leaderboard.

Importing this package registers the env ids, one per system: ``pinnobs/ReverseDuffing-v0`` and so
on. Everything else is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from pinnobs_gym.envs.registration import register_envs, register_system

if TYPE_CHECKING:
    from pinnobs_gym.envs.simulated import plot, simulate
    from pinnobs_gym.estimation.estimator import Estimates, Estimator, State
    from pinnobs_gym.estimation.live import Live
    from pinnobs_gym.leaderboard.published.trained import load
    from pinnobs_gym.scoring.evaluation import evaluate
    from pinnobs_gym.scoring.log_evaluation import evaluate_logs
    from pinnobs_gym.scoring.table import read_rows
    from pinnobs_gym.simulation.augmented import augmented
    from pinnobs_gym.simulation.augmented_system import Unknown
    from pinnobs_gym.simulation.record import Prior, Record
    from pinnobs_gym.simulation.system import Setup, System, independent, stack
    from pinnobs_gym.simulation.table import table

__all__ = [
    "Estimates",
    "Estimator",
    "Live",
    "Prior",
    "Record",
    "Setup",
    "State",
    "System",
    "Unknown",
    "__version__",
    "augmented",
    "evaluate",
    "evaluate_logs",
    "independent",
    "load",
    "plot",
    "read_rows",
    "register",
    "simulate",
    "stack",
    "table",
]

__version__: str
"""Version of the installed package."""

_HOMES = {
    "Estimates": "estimation.estimator",
    "Estimator": "estimation.estimator",
    "State": "estimation.estimator",
    "Live": "estimation.live",
    "Prior": "simulation.record",
    "Record": "simulation.record",
    "plot": "envs.simulated",
    "simulate": "envs.simulated",
    "Setup": "simulation.system",
    "System": "simulation.system",
    "independent": "simulation.system",
    "Unknown": "simulation.augmented_system",
    "augmented": "simulation.augmented",
    "stack": "simulation.system",
    "table": "simulation.table",
    "evaluate": "scoring.evaluation",
    "evaluate_logs": "scoring.log_evaluation",
    "load": "leaderboard.published.trained",
    "read_rows": "scoring.table",
}
"""Submodule that defines each lazily imported public name."""


def register(cls: type) -> type:
    """Register your own system, estimator or trainer under its name; usable as a decorator.

    A `System` becomes an env (``pinnobs/<class name>-v<version>``) that every estimator, trainer
    and command accepts. An estimator or a trainer is registered under its class attribute ``name``.

    Returns:
        The class itself.

    Raises:
        TypeError: in one line, if the class is no `System`, estimator or trainer, or is abstract.
        ValueError: if the name is taken.
    """
    from pinnobs_gym.estimation.estimator import BaseEstimator
    from pinnobs_gym.estimators import ESTIMATORS
    from pinnobs_gym.simulation.system import System

    if isinstance(cls, type) and issubclass(cls, System):
        register_system(cls)
    elif isinstance(cls, type) and issubclass(cls, BaseEstimator):
        ESTIMATORS.register(cls)
    else:
        from pinnobs_gym.registry import TRAINERS
        from pinnobs_gym.training.trainer import Trainer

        if not (isinstance(cls, type) and issubclass(cls, Trainer)):
            raise TypeError(f"{cls!r} is neither a System, an Estimator nor a Trainer")
        TRAINERS.register(cls)
    return cls


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("pinnobs-gym")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
