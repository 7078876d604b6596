"""The jobs of a leaderboard, each a pure function of what it says that appends its own rows."""

from __future__ import annotations

import hashlib
import importlib
import json
import pkgutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Self

from pinnobs_gym import env_id
from pinnobs_gym import rows as rows_module
from pinnobs_gym.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.evaluation import (
    Results,
    canonical,
    log_episodes,
    log_summary,
    make_vector_env,
    now,
    run_episodes,
    versions,
)
from pinnobs_gym.log import Log
from pinnobs_gym.record import Record
from pinnobs_gym.rows import Row
from pinnobs_gym.system import Setup, System

TRAINING_SEED = 10**6
"""Seed of the first episode that an estimator trained beforehand learns from; further ones have the
seeds after it, as many as its trainer's Config says (``episodes``). None is scored on them."""


@dataclass(frozen=True)
class Job:
    """One evaluation, to be run in any process."""

    system: str
    """Name or ``module:Class`` of the system."""
    estimator: str
    """Name or ``module:Class`` of the estimator."""
    setup: str
    condition: str
    episodes: int
    seed: int
    folder: Path
    """Where rows, TensorBoard's log and trained files go."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Choices in the trainer's Config, for estimators that learn."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The estimator's own settings."""
    label: str | None = None
    """The estimator's name in rows, if not its own."""
    known: frozenset[tuple[str, int | None, int]] | None = None
    """What is stored already; see `Results`."""
    failed: bool = False
    """Whether it failed before, and is tried again."""

    @property
    def rows(self) -> Path:
        """The rows file."""
        return self.folder / "rows.jsonl"

    @property
    def name(self) -> str:
        """What the job does, in a few words."""
        many = f"{self.episodes} episodes" if self.episodes > 1 else f"episode {self.seed}"
        return f"{self.label or self.estimator} on {self.system}, {self.condition}, {many}"

    @property
    def digest(self) -> str:
        """A hash of all that is asked for."""
        aside = {f.name: None for f in fields(self) if f.name in ("folder", "known", "failed")}
        return _digest({f.name: getattr(self, f.name) for f in fields(self)} | aside)

    def run(self) -> None:
        """Append the rows that are missing; see `run_job`."""
        run_job(self)
        if self.failed:
            rows_module.append(self.rows, [self._event("recovery")])

    def anew(self) -> Self:
        """The same job, when it is not known any more what is stored."""
        return replace(self, known=None)

    def fail(self, error: str) -> None:
        """Append a row that says what went wrong.

        Raises:
            CannotWrite: if it cannot.
        """
        rows_module.append(self.rows, [self._event("failure") | {"error": error}])

    def _event(self, kind: str) -> Row:
        return {
            "schema": rows_module.SCHEMA,
            "kind": kind,
            "env_id": env_id(self.system),
            "setup": self.setup,
            "condition": self.condition,
            "estimator": self.label or ESTIMATORS.name_of(ESTIMATORS.resolve(self.estimator)),
            "episode_seed": self.seed,
            "episodes": self.episodes,
            "job": self.digest,
            "versions": versions(),
            "date": now(),
        }


class Played(NamedTuple):
    """The episodes of an env: what is played, and from which seed on."""

    env_id: str
    setup: str
    condition: str
    seed: int


def trainers() -> dict[str, ModuleType]:
    """The trainers' modules by name."""
    package = importlib.import_module("trainers")
    names = [module.name for module in pkgutil.iter_modules(package.__path__)]
    return {name: importlib.import_module(f"trainers.{name}") for name in sorted(names)}


def trainer(name: str) -> ModuleType:
    """The trainer of that name.

    Raises:
        ValueError: listing the known ones, if it is unknown.
    """
    known = trainers()
    if name not in known:
        raise ValueError(f"unknown trainer {name!r}; known are {', '.join(known)}")
    return known[name]


def run_job(job: Job) -> None:
    """Train if the estimator needs it, evaluate, and append the rows that are missing."""
    import torch

    torch.set_num_threads(1)
    name = env_id(job.system)
    cls = ESTIMATORS.resolve(job.estimator)
    options = dict(job.settings)
    estimator: Estimator | type[Estimator] = cls
    if cls.trains_on_record is not None:
        recipe = trainer(cls.trains_on_record).Config(**job.training)
        place = f"{_played(job)}-{cls.trains_on_record}-{_digest(recipe)}-episode{job.seed}"
        options = {"config": recipe, "folder": job.folder / "trained" / place}
    elif cls.needs_training is not None:
        estimator = trained(cls, job)
    seeds = range(job.seed, job.seed + job.episodes)
    results = Results(job.rows, job.known)
    found, made, example = run_episodes(
        estimator, name, seeds, job.setup, job.condition, options, results, label=job.label
    )
    scored = [row for row in found if "nrmse" in row]
    if example is not None:  # something was run, and not all of it was there already
        with Log(log_folder(job.folder, scored[0])) as log:
            log_episodes(log, scored, made, example)


def log_folder(folder: Path, row: Row) -> Path:
    """Where TensorBoard's log of a row's estimator lies: other settings of it have their own."""
    system = row["env_id"].removeprefix("pinnobs/")
    played = folder / "tensorboard" / system / row["setup"] / row["condition"]
    return played / row["estimator"] / row["config_hash"]


def log_summaries(folder: Path, rows: Iterable[Row]) -> None:
    """Log what came of every estimator in these rows for TensorBoard's HPARAMS table."""
    groups: dict[Path, list[Row]] = {}
    for row in rows:
        groups.setdefault(log_folder(folder, row), []).append(row)
    for place, group in groups.items():
        with Log(place) as log:
            log_summary(log, group)


def trained(cls: type[Estimator], job: Job) -> Estimator:
    """The estimator trained on episodes that are never scored, loaded if that was done before."""
    name = str(cls.needs_training)
    recipe = trainer(name).Config(**{**cls.recipe, **job.training})
    played = Played(env_id(job.system), job.setup, job.condition, TRAINING_SEED)
    label = f"{_played(job)}-{name}-{_digest(recipe)}"
    path = job.folder / "trained" / f"{label}.pt"
    if not path.exists():
        with Log(job.folder / "tensorboard" / "training" / label) as log:
            result = train(name, recipe, played, log=log)
        if not path.exists():  # of two that trained at the same time, the first counts
            result.save(path)
    source = make_vector_env(played.env_id, 1, played.setup, played.condition).source
    return load(cls, path, source.system, source.setup)


def train(name: str, config: Any, played: Played, **options: Any) -> Any:
    """What the trainer of that name makes of a config: an object with `save`.

    A trainer learns from the record of ``config.episodes`` episodes and is given it, with the noise
    that the setup tells; or, if these are none, it plays episodes itself and is told of which env.

    Args:
        name: the trainer's.
        config: its Config.
        played: the episodes, or the first of them.
        options: ``log``, ``checkpoint``, ``resume`` and ``progress``, as the trainer takes them.
    """
    module = trainer(name)
    if not config.episodes:
        system = make_vector_env(played.env_id, 1, played.setup, played.condition).source.system
        return module.train(system, config, played=played, **options)
    system, setup, record = record_of(*played, config.episodes)
    return module.train(system, config, record=record, noise_std=setup.noise_std, **options)


def _played(job: Job) -> str:
    return f"{env_id(job.system).removeprefix('pinnobs/')}-{job.setup}-{job.condition}"


def _digest(recipe: Any) -> str:
    """Tells recipes apart in the names of files."""
    text = json.dumps(canonical(recipe), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:8]


def load(cls: type[Estimator], path: Path, system: System, setup: Setup) -> Estimator:
    """The trained estimator in a file, told what a setup says of the noise.

    Raises:
        ValueError: in one line, if it cannot be read or belongs to another system.
    """
    if cls.needs_training is None:
        raise ValueError(f"estimator {ESTIMATORS.name_of(cls)!r} is not one that is trained first")
    trained_cls: Any = cls
    estimator = trained_cls.load(path, system)
    return replace(estimator, noise_std=setup.noise_std) if "noise" in cls.knows else estimator


def record_of(
    name: str, setup: str, condition: str, seed: int, episodes: int = 1
) -> tuple[System, Setup, Record]:
    """An env's model, what estimators are told of the setup, and the record of its episodes of the
    seeds from seed on."""
    env = make_vector_env(name, episodes, setup, condition)
    env.reset(seed=seed)
    return env.source.system, env.source.setup, env.record()
