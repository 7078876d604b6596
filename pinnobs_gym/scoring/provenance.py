"""The provenance of a score: code, settings, versions and date."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import platform
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Any
from uuid import uuid4

import numpy as np

from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.game import GivenModel
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.simulation.code_hash import Unreadable, code_hash, content, digest
from pinnobs_gym.simulation.system import System

_GAME = (
    "pinnobs_gym.envs.episodes",
    "pinnobs_gym.scoring.metrics",
    "pinnobs_gym.scoring.consistency",
    "pinnobs_gym.scoring.cramer_rao",
)
"""The modules that make and score episodes, with what they import."""
_LOGS = ("pinnobs_gym.scoring.known_states", "pinnobs_gym.scoring.log_playing")
"""Those that score logs. How a log is read does not count: the numbers of episodes tell what was
read."""


def game_hash(source: GivenModel) -> str:
    """Return the hash of a game: the code of its system, of the simulation and of the scores, its
    setup and the system's parameters. Scores with another hash are not comparable.

    That of logs depends on the noise and the prior that estimators are told, and not on the logs,
    which are its episodes.

    A game whose code cannot be read has another hash each time.
    """
    try:
        own = _GAME if isinstance(source, EpisodeSource) else _LOGS
        code = code_hash(type(source.system), *own)
        return digest([code, content(source.system), content(source.setup)])
    except Unreadable:
        return unique()


UNREADABLE = "unreadable"
"""The hash of code that cannot be read."""


def estimator_code(cls: type[BaseEstimator]) -> str:
    """Return the hash of the code of an estimator and, if it trains on each record, of its trainer;
    `UNREADABLE` if the code cannot be read."""
    try:
        return code_hash(cls, *(() if cls.trains_on_record is None else (trainer_class(cls),)))
    except Unreadable:
        return UNREADABLE


def training_code(trainer: type, source: EpisodeSource) -> str:
    """Return the hash of what a trained estimator depends on beside the settings: the code of its
    trainer, and that of the episodes. If it cannot be read, the hash is another each time."""
    try:
        return code_hash(
            trainer,
            type(source.system),
            "pinnobs_gym.envs.episodes",
            "pinnobs_gym.training.loop",
        )
    except Unreadable:
        return unique()


def estimator_hash(estimator: BaseEstimator) -> str:
    """Return the hash of an estimator: its code, its settings, its model, the noise that it is
    told, and what was trained.

    If a part cannot be read, such as a lambda among the settings, the hash is another each time, so
    that its scores are never taken for those of another estimator.
    """
    held = getattr(estimator, "trained", None)
    names = [f.name for f in fields(held) if f.name != "seconds"] if is_dataclass(held) else []
    training = {name: value for name, value in estimator.training.items() if name != "seconds"}
    parts = {
        "model": estimator.system,
        "noise": estimator.system.noise(estimator.noise_std, estimator.process_noise),
        "options": estimator.options,
        "training": training,
        "trained": {name: getattr(held, name) for name in names},
    }
    code = estimator_code(type(estimator))
    try:
        return unique() if code == UNREADABLE else digest([code, content(parts)])
    except Unreadable:
        return unique()


def unique() -> str:
    """Return a hash that equals no other."""
    return f"once{uuid4().hex[:8]}"


def canonical(value: Any) -> Any:
    """Convert a value to JSON's types, equal values to equal results. Numbers that are not finite
    are converted to texts such as ``inf``, and objects other than data to the name of their class
    or function."""
    if isinstance(value, float) and not math.isfinite(value):
        return str(float(value))
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return canonical(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): canonical(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [canonical(part) for part in value]
    if isinstance(value, System):
        return {"system": type(value).__name__, **canonical(value.parameters)}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: canonical(getattr(value, f.name)) for f in fields(value) if f.repr}
    if isinstance(value, np.generic):
        return canonical(value.item())
    return getattr(value, "__qualname__", type(value).__qualname__)


def settings_digest(settings: Any) -> str:
    """Return a short hash that distinguishes settings, such as recipes, in names of files."""
    text = json.dumps(canonical(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that a score depends on."""
    packages = ("pinnobs-gym", "numpy", "scipy", "torch", "gymnasium")
    installed = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), **installed}


def now(after: str = "") -> str:
    """Return the date and time (UTC) in the format of rows, but a later one than another date, also
    if the clock has gone back since."""
    date = datetime.now(UTC)
    if after >= date.isoformat(timespec="milliseconds"):
        last = datetime.fromisoformat(after)
        date = (last if last.tzinfo else last.replace(tzinfo=UTC)) + timedelta(milliseconds=1)
    return date.isoformat(timespec="milliseconds")
