"""Published files of trained estimators: which one serves a training, and loading by name."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import AnyGame, Game
from pinnobs_gym.estimation.estimator import BaseEstimator, labelled
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.published.manifest import Manifest, PublishedTraining
from pinnobs_gym.leaderboard.published.reading import present
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring.provenance import canonical, settings_digest, training_code
from pinnobs_gym.simulation.code_hash import content
from pinnobs_gym.simulation.code_source import digest
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.training import by_name


@dataclass(frozen=True)
class Training:
    """What identifies a training, apart from its code."""

    cls: type[BaseEstimator]
    """The estimator that is trained."""
    game: Game
    """The game on whose episodes it is trained."""
    recipe: Any
    """The trainer's settings."""
    seed: int | None = None
    """Seed of the episode if it serves this episode alone."""

    @property
    def facts(self) -> dict[str, Any]:
        """The fields of the `PublishedTraining` that has its result."""
        system, setup = self.game.source.system, self.game.source.setup
        return {
            **self.game.name._asdict(),
            "trainer": trainer_class(self.cls).name,
            "recipe": settings_digest(self.recipe),
            "model": settings_digest([canonical(system), canonical(setup)]),
            "seed": self.seed,
        }

    @property
    def code(self) -> str:
        """Hash of its present code; see `pinnobs_gym.scoring.provenance.training_code`."""
        return training_code(trainer_class(self.cls), self.game.source)


def published_for(training: Training, published: Manifest) -> PublishedTraining | None:
    """Return the published result of a training, possibly of earlier code; None if there is
    none."""
    facts = training.facts
    for entry in published.trained:
        if all(getattr(entry, name) == value for name, value in facts.items()):
            return entry
    return None


@contextmanager
def opened(published: Manifest, entry: PublishedTraining) -> Iterator[Path]:
    """Yield the path of a temporary file with a published trained object.

    Raises:
        ValueError: in one line, if the file is not the one that was published.
    """
    data = published.content(entry)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / Path(entry.file).stem
        path.write_bytes(data)
        yield path


def record_hash(record: Record) -> str:
    """Return the hash of all that an estimator is given of an episode."""
    return digest(content([record.t, record.y, record.u, record.prior.mean, record.prior.cov]))


def load(name: str, system: str | type[System], setup: str = "benchmark") -> BaseEstimator:
    """Return a trained estimator that ships with the package, ready to use.

    It is the one that the published leaderboard scored first: of the first training seed. An
    estimator that uses the noise is given that of the setup.

    Args:
        name: name of the estimator, such as ``kkl_pinn``; with its recipe, as tables have it, if
            not its usual one is wanted.
        system: name, class or env id of the system.
        setup: the setup whose training and noise it has.

    Raises:
        ValueError: in one line, if the name or the system is unknown, nothing is published for
            them, the file is of another version or damaged, or the system's parameters are others.
    """
    game = Game.of(system, setup)
    return load_published(name, game)


def load_published(name: str, game: AnyGame) -> BaseEstimator:
    """Return a published trained estimator for a game; see `load`."""
    cls = ESTIMATORS.resolve(name.partition(" (")[0])
    if cls.needs_training is None:
        how = "trains on each record" if cls.trains_on_record else "needs no training"
        raise ValueError(f"estimator {name!r} {how}; no trained file of it is published")
    published, nominal = present(), game.nominal.name
    trainer = trainer_class(cls).name
    usual = [entry for entry in published.trained if entry.trainer == trainer and not entry.record]
    own = [entry for entry in usual if _called(entry, name, cls)]
    found = [entry for entry in own if entry.game == nominal]
    if not found:
        known = sorted({_in_words(entry) for entry in usual})
        raise ValueError(
            f"no trained file of {name!r} on {nominal.system}, {nominal.setup}, is published; "
            f"published are {', '.join(known) or 'none of this estimator'}"
        )
    with opened(published, found[0]) as path:
        return by_name.load(cls, path, game)


def _called(entry: PublishedTraining, name: str, cls: type[BaseEstimator]) -> bool:
    """Return whether a published training is the one of a name: with its recipe, or its usual
    one."""
    if entry.estimator == name:
        return True
    base = ESTIMATORS.name_of(cls)
    return name == base and entry.estimator == labelled(base, cls.trainer_config({}).recipe)


def _in_words(entry: PublishedTraining) -> str:
    setup = "" if entry.setup == "benchmark" else f", {entry.setup}"
    return f"{entry.estimator} on {entry.game.system}{setup}"
