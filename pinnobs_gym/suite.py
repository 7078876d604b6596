"""Running many evaluations: jobs, each a pure function that appends its own rows."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import pkgutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import joblib

from pinnobs_gym import env_id
from pinnobs_gym.conditions import canonical_name, fitting
from pinnobs_gym.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.evaluation import (
    canonical,
    log_episodes,
    log_summary,
    make_vector_env,
    run_episodes,
)
from pinnobs_gym.log import Log
from pinnobs_gym.record import Record
from pinnobs_gym.rows import Row
from pinnobs_gym.system import Setup, System
from pinnobs_gym.systems import SYSTEMS

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

    @property
    def rows(self) -> Path:
        """The rows file."""
        return self.folder / "rows.jsonl"

    @property
    def name(self) -> str:
        """What the job does, in a few words."""
        return f"{self.estimator} on {self.system}, {self.condition}"


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


def default_estimators() -> tuple[str, ...]:
    """All that can be scored on episodes they have not seen."""
    return tuple(
        name
        for name, cls in ESTIMATORS.classes().items()
        if cls.needs_training is None or cls.track == "online"
    )


def jobs_of(
    systems: Sequence[str],
    estimators: Sequence[str],
    *,
    setup: str,
    conditions: Sequence[str],
    episodes: int,
    trained_episodes: int,
    seed: int,
    folder: Path,
    training: Mapping[str, Any],
) -> list[Job]:
    """The jobs of a cross of systems and estimators, the longest first.

    Without conditions every system is played under the nominal one, and under that it is ranked
    under if this is another. ``all`` stands for these and, for estimators that need no training,
    for all others that fit the system. Estimators that train on each record get their own, smaller
    number of episodes, a job each.
    """
    if "all" in conditions and len(conditions) > 1:
        raise ValueError(f"conditions {' '.join(conditions)}: 'all' stands alone")
    quick, long = [], []
    for estimator in estimators:
        cls = ESTIMATORS.resolve(estimator)
        if cls.needs_training is not None and cls.track == "offline":
            raise ValueError(f"estimator {estimator!r} knows one record; it cannot be ranked")
        for system in systems:
            name, ranked = env_id(system), SYSTEMS.resolve(system).ranked_condition
            played = list(dict.fromkeys(["nominal", canonical_name(ranked)]))
            if list(conditions) != ["all"]:
                played = list(dict.fromkeys(map(canonical_name, conditions))) or played
            elif cls.needs_training is None and cls.trains_on_record is None:
                model, chosen = SYSTEMS.resolve(system).configured(setup)
                played += [name for name in fitting(model, chosen) if name not in played]
            for each in played:
                # A bad combination is refused before any run.
                source = make_vector_env(name, 1, setup, each).source
                count = 1 if source.deterministic else episodes
                job = Job(system, estimator, setup, each, count, seed, folder, dict(training))
                if cls.trains_on_record is None:
                    (quick if cls.needs_training is None else long).append(job)
                else:
                    for i in range(min(count, trained_episodes)):
                        long.append(replace(job, episodes=1, seed=seed + i))
    return long + quick


def run_jobs(jobs: Sequence[Job], processes: int) -> Iterator[tuple[Job, str | None]]:
    """Run jobs, one thread each, and yield each as it ends, with what went wrong if it failed."""
    if processes == 1:
        yield from map(_attempt, jobs)
        return
    with joblib.parallel_config("loky", n_jobs=processes, inner_max_num_threads=1):
        parallel: Any = joblib.Parallel(return_as="generator_unordered")
        yield from parallel(joblib.delayed(_attempt)(job) for job in jobs)


def _attempt(job: Job) -> tuple[Job, str | None]:
    try:
        run_job(job)
    except Exception as error:
        return job, f"{type(error).__name__}: {error}"
    return job, None


def run_job(job: Job) -> None:
    """Train if the estimator needs it, evaluate, and append the rows that are missing."""
    import torch

    torch.set_num_threads(1)
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # for module:Class of the user's folder, in workers too
    name = env_id(job.system)
    cls = ESTIMATORS.resolve(job.estimator)
    options: dict[str, Any] = {}
    estimator: Estimator | type[Estimator] = cls
    if cls.trains_on_record is not None:
        recipe = trainer(cls.trains_on_record).Config(**job.training)
        place = f"{_played(job)}-{cls.trains_on_record}-{_digest(recipe)}-episode{job.seed}"
        options = {"config": recipe, "folder": job.folder / "trained" / place}
    elif cls.needs_training is not None:
        estimator = trained(cls, job)
    seeds = range(job.seed, job.seed + job.episodes)
    scored, made, example = run_episodes(
        estimator, name, seeds, job.setup, job.condition, options, job.rows
    )
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
            train(name, recipe, played, log=log).save(path)
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
