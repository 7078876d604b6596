"""Running an estimator on a batch of a game's episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.envs.game import AnyGame, Game, GameName
from pinnobs_gym.estimation.estimator import BaseEstimator, Estimates
from pinnobs_gym.scoring.cramer_rao import Reference, reference
from pinnobs_gym.scoring.known_states import counted, score_known
from pinnobs_gym.scoring.metrics import Scores, score
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_REFERENCES: dict[tuple[type[System], GameName, tuple[int, ...]], Reference | None] = {}
"""Cache of the latest batches' references, since several estimators play the same episodes."""
_MOST_REFERENCES = 8
_PREPARED: WeakValueDictionary[int, BaseEstimator] = WeakValueDictionary()
"""The estimators that have run before, by their ids."""


@dataclass(frozen=True)
class Played:
    """A batch of episodes with an estimator's results."""

    game: AnyGame
    seeds: tuple[int, ...]
    """Seeds of the episodes; of a log, the number of its episode."""
    record: Record
    """The record given to the estimator."""
    truth: np.ndarray
    """True states at the record's samples, shape (batch, num_samples, nx), in state units; NaN
    where the reference of a log has none."""
    estimates: Estimates
    """x̂(k|k) at the same samples."""
    us_per_step: float
    """CPU microseconds per step and episode, without what an online estimator prepares once."""
    drawn: bool = True
    """Whether the initial states are those drawn by the game."""
    transient: float | None = None
    """End of the transient window of a log, in s from its first sample; None for a game that is
    simulated, whose setup says it."""

    @property
    def system(self) -> System:
        """The model."""
        return self.game.source.system

    @property
    def std(self) -> np.ndarray | None:
        """Standard deviations of the estimates, shape (batch, num_samples, nx); None without
        covariances."""
        P = self.estimates.P
        return None if P is None else np.sqrt(np.maximum(np.einsum("bkii->bki", P), 0))

    @cached_property
    def reference(self) -> Reference | None:
        """The Cramér-Rao reference of the episodes; None where it does not apply, as to logs, or
        where the initial states or the game's settings are changed."""
        if not isinstance(self.game, Game) or not self.drawn or self.game.changes:
            return None
        key = (type(self.system), self.game.name, self.seeds)
        if key not in _REFERENCES:
            while len(_REFERENCES) >= _MOST_REFERENCES:
                del _REFERENCES[next(iter(_REFERENCES))]
            _REFERENCES[key] = reference(self.game, self.record, self.truth)
        return _REFERENCES[key]

    @cached_property
    def scores(self) -> Scores:
        """The scores of the episodes, with the Cramér-Rao reference if there is one."""
        if self.reference is None:
            return self.scores_alone
        return replace(self.scores_alone, reference_steady=self.reference.steady)

    @cached_property
    def scores_alone(self) -> Scores:
        """The scores without the reference, which takes longer."""
        parts = self.system, self.record, self.truth, self.estimates
        if self.transient is not None:
            return score_known(*parts, self.transient)
        return score(*parts, self.game.source.setup.transient_end)

    @cached_property
    def scored(self) -> np.ndarray:
        """Which errors are scored, bool (batch, num_samples, nx)."""
        if self.transient is not None:
            return counted(self.system, self.truth, self.record.prior.mean)
        return np.asarray(self.system.observable(self.truth))

    def figure(self, title: str, row: int = 0) -> Figure:
        """Return a figure of one of the episodes, with a panel per state."""
        estimates, record = self.estimates, self.record
        P = None if estimates.P is None else estimates.P[row]
        shown = {"x": self.truth[row], "y": record.y[row], "P": P, "title": title}
        return state_figure(self.system, record.t, estimates.xhat[row], **shown)


def play(
    game: Game,
    estimator: BaseEstimator,
    seeds: Sequence[int],
    x0: np.ndarray | None = None,
    phase: Callable[[str], None] | None = None,
) -> Played:
    """Run an estimator on episodes of a game.

    The episodes are those of the env reset with these seeds; stepping it with x̂(k|k) as actions
    gives the same errors.

    Args:
        game: what is played.
        estimator: the estimator to run.
        seeds: of the episodes.
        x0: initial states (batch, nx) that replace the drawn ones.
        phase: called with what is done from then on.
    """
    source = game.source
    say = phase or (lambda doing: None)
    say("simulating")
    episodes = game.episodes(seeds, x0)
    record = source.record(episodes)
    truth = np.ascontiguousarray(episodes.x[: record.num_samples].swapaxes(0, 1))
    say("estimating")
    estimates, cost = timed(estimator, record)
    say("scoring")
    return Played(game, tuple(seeds), record, truth, estimates, cost, drawn=x0 is None)


def timed(estimator: BaseEstimator, record: Record) -> tuple[Estimates, float]:
    """Return the estimates for a record, and their cost in CPU microseconds per step and episode,
    without what an online estimator prepares once; see `BaseEstimator.run`."""
    _prepare(estimator, record)
    start = time.process_time()
    estimates = estimator.run(record)
    cost = (time.process_time() - start) / (record.num_samples * record.batch) * 1e6
    return estimates, cost


def _prepare(estimator: BaseEstimator, record: Record) -> None:
    """Run an online estimator on the first two samples of one episode, if it has not run before.
    What it derives from its model once, such as gains and compiled equations, is then no part of
    the cost of a step."""
    if estimator.track != "online" or estimator.trains_on_record is not None:
        return
    if _PREPARED.get(id(estimator)) is estimator:
        return
    _PREPARED[id(estimator)] = estimator
    with suppress(Exception):  # an error occurs again, and is told, in the run itself
        estimator.run(record.rows(slice(0, 1)).first_samples(2))
