"""The floor of a game as rows: the scores of the posterior mean under the law of its episodes.

The posterior mean has the least mean squared error of all estimates. Filtered, it bounds online
estimators, and smoothed offline ones: of root mean squares over many episodes, not of single ones.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.scoring.episode_law import EpisodeLaw
from pinnobs_gym.scoring.evaluation import (
    Results,
    estimator_fields,
    game_fields,
    score_episodes,
)
from pinnobs_gym.scoring.exact_bayes import LEAST_ESS, Posterior, Posteriors, exact_bayes
from pinnobs_gym.scoring.particle_reference import particle_reference
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.row_format import FLOOR, FLOOR_WHOLE
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.record import Record

LARGEST = 3
"""Largest number of states for which exact Bayes is computed."""


@dataclass(frozen=True)
class Floor(OfflineEstimator):
    """A posterior mean under the law of a game's episodes, which no estimator is told. Created by
    `Floor.of`."""

    game: Game | None = field(default=None, repr=False)
    """The game, whose law is known."""
    seed: int = 0
    """Seed of the draws."""

    knows = ("law of the episodes",)

    @classmethod
    def of(cls, game: Game, seed: int = 0) -> Self:
        """Return the floor of a game.

        Raises:
            ValueError: in one line, if it cannot be computed.
        """
        setup = game.source.setup
        made = cls(game.source.system, setup.noise_std, setup.process_noise, game, seed)
        made.check()
        return made

    @property
    def law(self) -> Game:
        """The game.

        Raises:
            ValueError: in one line, if it was created without.
        """
        if self.game is None:
            raise ValueError(f"{type(self).__name__} without a game; expected {type(self)}.of")
        return self.game

    @abstractmethod
    def check(self) -> None:
        """Raise ValueError, in one line, unless the floor of the game can be computed."""

    @abstractmethod
    def posterior(self, record: Record) -> Posterior:
        """Return the posterior of a record's episodes."""

    @abstractmethod
    def quality(self, record: Record) -> list[Row]:
        """Return how exact each episode's posterior is, as fields of rows."""

    def run(self, record: Record) -> Estimates:
        found = self.posterior(record)
        return Estimates(found.mean, found.cov)


@dataclass(frozen=True)
class ExactBayes(Floor):
    """The posterior mean given the outputs up to each sample (`exact_bayes`)."""

    given: str = "outputs so far"
    """What the posterior is conditioned on."""

    name = "exact_bayes"
    track = FLOOR

    def check(self) -> None:
        name, nx = type(self.system).__name__, self.system.nx
        if nx > LARGEST:
            raise ValueError(
                f"{name} has {nx} states; exact Bayes is computed for at most {LARGEST}"
            )
        EpisodeLaw.of(self.law.source)

    def posterior(self, record: Record) -> Posterior:
        return self._both(record).filtered

    def quality(self, record: Record) -> list[Row]:
        least = self._both(record).filtered.ess.min(axis=1)
        return [{"effective_sample_size": float(f"{value:.4g}")} for value in least]

    def _both(self, record: Record) -> Posteriors:
        """Return both posteriors; those of the latest record are kept, as both are scored."""
        key = (self.law.name, self.seed, _digest(record))
        if key not in _LATEST:
            _LATEST.clear()
            _LATEST[key] = exact_bayes(EpisodeLaw.of(self.law.source), record, seed=self.seed)
        return _LATEST[key]


@dataclass(frozen=True)
class ExactBayesSmoother(ExactBayes):
    """The posterior mean given all outputs of the record (`exact_bayes`)."""

    given: str = "all outputs"
    """What the posterior is conditioned on. As it differs from `ExactBayes.given`, so do the hashes
    of the two in rows."""

    name = "exact_bayes_smoother"
    track = FLOOR_WHOLE

    def posterior(self, record: Record) -> Posterior:
        return self._both(record).smoothed

    def quality(self, record: Record) -> list[Row]:
        least = self._both(record).smoothed.ess.min(axis=1)
        return [{"effective_sample_size": float(f"{value:.4g}")} for value in least]


@dataclass(frozen=True)
class ParticleReference(Floor):
    """The mean of two large particle filters, for plants with process noise
    (`particle_reference`)."""

    name = "particle_reference"
    track = FLOOR

    def check(self) -> None:
        if not self.law.source.noise.stochastic:
            name = type(self.system).__name__
            raise ValueError(f"{name} has no process noise; expected exact Bayes")

    def posterior(self, record: Record) -> Posterior:
        return self._found(record)[0]

    def quality(self, record: Record) -> list[Row]:
        return [{"monte_carlo": float(f"{value:.4g}")} for value in self._found(record)[1]]

    def _found(self, record: Record) -> tuple[Posterior, np.ndarray]:
        key = (self.law.name, self.seed, _digest(record))
        if key not in _LATEST:
            _LATEST.clear()
            _LATEST[key] = particle_reference(self.law.source, record, seed=self.seed)
        return _LATEST[key]


FLOORS = tuple(cls.name for cls in (ExactBayes, ExactBayesSmoother, ParticleReference))
"""The names of floors in rows."""
_LATEST: dict[Any, Any] = {}
"""The result for the latest record."""


def _digest(record: Record) -> str:
    """Return the hash of a record's outputs and inputs."""
    parts = (record.y, record.u)
    return hashlib.sha256(b"".join(np.ascontiguousarray(p).tobytes() for p in parts)).hexdigest()


def floors_of(game: Game) -> list[Floor]:
    """Return what bounds the errors in a game: exact Bayes, filtered and smoothed or, with process
    noise, a particle reference.

    Raises:
        ValueError: in one line, if there is none.
    """
    if game.source.noise.stochastic:
        return [ParticleReference.of(game)]
    return [ExactBayes.of(game), ExactBayesSmoother.of(game)]


def run_floor(
    game: Game,
    seeds: range,
    results: Path,
    fresh: bool = False,
    progress: Callable[[int], None] | None = None,
) -> list[Row]:
    """Compute the floor of episodes that are not stored yet, and append its rows.

    Args:
        game: what is played.
        seeds: of the episodes.
        results: the rows file.
        fresh: compute stored episodes again.
        progress: called with the number of episodes done, of each of `floors_of`.

    Returns:
        All rows of these episodes.
    """
    rows: list[Row] = []
    for floor in floors_of(game):

        def quality(played: Played, floor: Floor = floor) -> list[Row]:
            return floor.quality(played.record)

        common = {**game_fields(game), **estimator_fields(floor, game)}
        stored = Results(results, fresh=fresh)
        plays = partial(play, game, floor)
        rows += score_episodes(common, plays, seeds, stored, progress, quality).rows
    return rows


def too_few(rows: list[Row]) -> list[Row]:
    """Return the rows whose effective sample size is below `LEAST_ESS`."""
    return [row for row in rows if (row.get("effective_sample_size") or LEAST_ESS) < LEAST_ESS]
