"""The trainings of jobs: where their results are kept, and which of them are published."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import file_name
from pinnobs_gym.leaderboard.published.manifest import Manifest, PublishedTraining
from pinnobs_gym.leaderboard.published.trained import Training, published_for
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring.evaluation import StandIn
from pinnobs_gym.scoring.provenance import settings_digest

if TYPE_CHECKING:
    from pinnobs_gym.leaderboard.jobs.job import Job


def training_of(job: Job) -> Training | None:
    """Return the training that a job needs, None if it needs none. Estimators are trained under the
    nominal condition, unless they train on each record."""
    cls = ESTIMATORS.resolve(job.estimator)
    if not (cls.needs_training or cls.trains_on_record):
        return None
    recipe = cls.trainer_config(job.training)
    if cls.needs_training:
        return Training(cls, job.game.nominal, recipe)
    return Training(cls, job.game, recipe, job.seed)


def place_of(job: Job, training: Training, code: str | None = None) -> Path:
    """Return where the result of a job's training is kept: a file or, of a training on a record,
    the folder in which each of its rows has a folder.

    Args:
        job: the job.
        training: its training.
        code: hash of the training's code, if it is known.
    """
    recipe = settings_digest([training.recipe, code or training.code])
    trainer = file_name(trainer_class(training.cls).name)
    name = f"{training.game.name.file_stem}-{trainer}-{recipe}"
    name += ".pt" if training.seed is None else f"-episode{training.seed}"
    return job.folder / "trained" / name


def published_of(job: Job, training: Training) -> tuple[Manifest, PublishedTraining] | None:
    """Return the published result of a job's training with the list that it is in; None if there is
    none, or if the job is to train anew.

    Raises:
        ValueError: in one line, if the list is damaged or of another version.
    """
    published = None if job.published is None else Manifest.read(job.published)
    entry = None if published is None else published_for(training, published)
    return None if published is None or entry is None else (published, entry)


def stand_in(job: Job, training: Training, estimator: Any) -> StandIn | None:
    """Return what plays a published network in the place of an estimator that trains on each
    record; None if none is published for the job's episode."""
    published = published_of(job, training)
    if published is None:
        return None
    from pinnobs_gym.leaderboard.published.on_record import stand_in

    return stand_in(estimator, job.game, *published)


class Outlook:
    """What the trainings of many jobs will do. The code of each trainer is hashed only once for
    each system, since this takes long."""

    def __init__(self) -> None:
        self._codes: dict[tuple[type, type], str] = {}

    def will_train(self, job: Job) -> bool:
        """Return whether a job has a training ahead: one whose result is neither in its folder nor
        published."""
        training = training_of(job)
        if training is None or published_of(job, training) is not None:
            return False
        return training.seed is not None or not self._is_kept(job, training)

    def outdated(self, jobs: Iterable[Job]) -> dict[str, list[str]]:
        """Return the systems, by estimator, on which jobs use a published training whose code has
        changed since."""
        found: dict[str, dict[str, None]] = defaultdict(dict)
        for job in jobs:
            training = training_of(job)
            published = None if training is None else published_of(job, training)
            if training is None or published is None or published[1].code == self._code(training):
                continue
            if training.seed is not None or not self._is_kept(job, training):
                found[job.called][job.game.name.system] = None
        return {name: list(systems) for name, systems in found.items()}

    def _is_kept(self, job: Job, training: Training) -> bool:
        return place_of(job, training, self._code(training)).exists()

    def _code(self, training: Training) -> str:
        key = trainer_class(training.cls), type(training.game.source.system)
        if key not in self._codes:
            self._codes[key] = training.code
        return self._codes[key]
