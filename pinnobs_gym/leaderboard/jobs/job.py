"""The jobs of a leaderboard. The result of a job depends only on its fields; it appends its own
rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator, labelled
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import noticing_full_disks
from pinnobs_gym.leaderboard.jobs import trainings
from pinnobs_gym.leaderboard.published.trained import Training, opened
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.evaluation import Results, StoredKey, make_estimator, run_episodes
from pinnobs_gym.scoring.provenance import (
    estimator_code,
    game_hash,
    now,
    settings_digest,
    training_code,
    versions,
)
from pinnobs_gym.scoring.recency import LastUse
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.scoring.tensorboard import log_episodes, log_folder
from pinnobs_gym.scoring.tuned import SUFFIX, is_tuned
from pinnobs_gym.training.by_name import load, train_by_name
from pinnobs_gym.training.log import Log


@dataclass(frozen=True)
class Job:
    """One evaluation, which any process can run."""

    game: Game
    """The game to play."""
    estimator: str
    """Name or ``module:Class`` of the estimator."""
    episodes: int
    seed: int
    folder: Path
    """Folder of rows, TensorBoard log and trained files."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Values of the trainer's Config, for trained estimators."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """The estimator's own settings."""
    label: str | None = None
    """Name of the estimator in rows; its own, with its recipe, if None."""
    known: frozenset[StoredKey] | None = None
    """Keys of the stored rows; see `Results`."""
    last_use: LastUse | None = None
    """When the code of the same game was used last; see `Results`."""
    fresh: bool = False
    """Whether stored episodes are run again; see `Results`."""
    failed: bool = False
    """Whether the job failed before and is retried."""
    published: Path | None = None
    """Folder of published results, whose trained files are used instead of training; None to train
    anew."""
    time_limit: float | None = None
    """Longest time in s of wall-clock time that it may take in a worker; None for no limit."""

    @property
    def rows(self) -> Path:
        """The rows file."""
        return self.folder / "rows.jsonl"

    @property
    def called(self) -> str:
        """Name of the estimator in rows, unless its class makes another; see
        `BaseEstimator.label`."""
        if self.label is not None:
            return self.label
        cls = ESTIMATORS.resolve(self.estimator)
        tuned = is_tuned(cls, self.settings, self.game)
        return called(cls, self.training) + (SUFFIX if tuned else "")

    @property
    def name(self) -> str:
        """Short description of the job."""
        many = f"{self.episodes} episodes" if self.episodes > 1 else f"episode {self.seed}"
        system, condition = self.game.system.partition(":")[2], self.game.name.condition
        return f"{self.called} on {system}, {condition}, {many}"

    @property
    def digest(self) -> str:
        """Hash of the job's specification and of the code that it runs."""
        aside = ("folder", "known", "last_use", "fresh", "failed", "published", "time_limit")
        own = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in aside}
        cls = ESTIMATORS.resolve(self.estimator)
        code = [game_hash(self.game.source), estimator_code(cls)]
        if cls.needs_training is not None:
            code.append(training_code(trainer_class(cls), self.game.source))
        return settings_digest({**own, "code": code})

    def run(self) -> None:
        """Append the missing rows; see `run_job`."""
        with noticing_full_disks():
            run_job(self)
        if self.failed:
            rows_module.append(self.rows, [self._event("recovery")])

    def anew(self) -> Self:
        """Return the same job without its knowledge of stored rows."""
        return replace(self, known=None, last_use=None)

    def fail(self, error: str) -> None:
        """Append a row with the error.

        Raises:
            CannotWrite: if it cannot be written.
        """
        rows_module.append(self.rows, [self._event("failure") | {"error": error}])

    def _event(self, kind: str) -> Row:
        return {
            "schema": rows_module.SCHEMA,
            "kind": kind,
            **self.game.name._asdict(),
            "estimator": self.called,
            "episode": rows_module.episode_of(self.seed),
            "episodes": self.episodes,
            "job": self.digest,
            "versions": versions(),
            "date": now(),
        }


def called(cls: type[BaseEstimator], training: Mapping[str, Any]) -> str:
    """Return the name in rows of an estimator, given values of its trainer's Config if it is
    trained."""
    trained = cls.needs_training or cls.trains_on_record
    return labelled(ESTIMATORS.name_of(cls), cls.trainer_config(training).recipe if trained else "")


def run_job(job: Job) -> None:
    """Train the estimator if needed, evaluate it, and append the missing rows."""
    training, stand_in = trainings.training_of(job), None
    if training is None:
        estimator = make_estimator(job.estimator, job.game, job.settings)
    else:
        import torch

        torch.set_num_threads(1)  # a job is one thread
        if training.seed is None:
            estimator = trained(training, job)
        else:
            options = {"config": training.recipe, "folder": trainings.place_of(job, training)}
            estimator = make_estimator(training.cls, job.game, options)
            stand_in = trainings.stand_in(job, training, estimator)
    seeds = range(job.seed, job.seed + job.episodes)
    results = Results(job.rows, job.known, job.fresh, job.last_use)
    evaluated = run_episodes(
        job.game, estimator, seeds, results, label=job.label, stand_in=stand_in
    )
    scored = [row for row in evaluated.rows if "nrmse" in row]
    if evaluated.first_played is not None:  # some episodes were not stored
        with Log(log_folder(job.folder, scored[0])) as log:
            log_episodes(log, scored, evaluated.first_played)


def trained(training: Training, job: Job) -> BaseEstimator:
    """Return the estimator trained on nominal episodes that are never scored; load it if it was
    trained before, in this folder or for the published results."""
    cls, path = training.cls, trainings.place_of(job, training)
    if path.exists():
        return load(cls, path, job.game)
    published = trainings.published_of(job, training)
    if published is not None:
        with opened(*published) as shipped:
            return load(cls, shipped, job.game)
    with Log(job.folder / "tensorboard" / "training" / path.stem) as log:
        result = train_by_name(trainer_class(cls), training.recipe, training.game, log=log)
    if not path.exists():  # of two simultaneous trainings, the first counts
        result.save(path)
    return load(cls, path, job.game)
