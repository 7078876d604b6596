"""Scores of estimates that were made elsewhere, from the records of
`pinnobs_gym.scoring.episode_folder`.

Whether such estimates are causal cannot be checked. Their rows therefore have tracks of their own,
in which they are ranked among themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import Estimates, OfflineEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.episode_table import Cells, read_cells
from pinnobs_gym.scoring.evaluation import Evaluated, Results, game_fields, score_episodes
from pinnobs_gym.scoring.floor import FLOORS
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.provenance import versions
from pinnobs_gym.scoring.row_format import NAME_EXPECTED, SUBMITTED, Row, is_name
from pinnobs_gym.scoring.sample_cells import finite_or_lost, match_samples, not_negative
from pinnobs_gym.scoring.tuned import SUFFIX
from pinnobs_gym.simulation.code_hash import content, digest
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.training.trainer import TRAINING_SEED

Claim: TypeAlias = Literal["online", "offline"]
"""What the submitter says: whether x̂_k is made of y₀ … y_k alone, or of the whole record."""


@dataclass(frozen=True)
class Submission:
    """Estimates of all episodes of a game, as they were submitted."""

    name: str
    """Name of the estimator in tables."""
    seeds: range
    """Of the episodes."""
    estimates: Estimates
    """The estimates (episodes, num_samples, nx) in the order of seeds; with standard deviations,
    diagonal covariances."""
    claim: Claim = "online"
    knows: tuple[str, ...] = ("model", "prior", "noise")
    """What was used beside the records, as the submitter says."""

    @property
    def track(self) -> str:
        """The track of its rows."""
        return f"{self.claim}, {SUBMITTED}"

    @cached_property
    def content(self) -> str:
        """The hash of the estimates."""
        return digest(content([self.estimates.xhat, self.estimates.P]))

    def fields(self) -> Row:
        """Return the fields of rows that say which estimator this is."""
        knows = list(dict.fromkeys((SUBMITTED, *self.knows)))
        return {
            "estimator": self.name,
            "track": self.track,
            "knows": knows,
            "options": {"estimates": self.content},
            "settings": {},
            "estimator_code": SUBMITTED,
            "estimator_hash": digest([SUBMITTED, self.content, self.track, knows]),
            "training": {},
            "training_seed": None,
            "versions": versions(),
            "us_per_step": None,
        }


@dataclass(frozen=True)
class _Replay(OfflineEstimator):
    """Returns given estimates, whatever the record."""

    given: Estimates = field(kw_only=True, repr=False)

    def run(self, record: Record) -> Estimates:
        return self.given


def score_submission(
    game: Game,
    submission: Submission,
    results: Results | None = None,
    progress: Callable[[int], None] | None = None,
) -> Evaluated:
    """Score submitted estimates as `pinnobs_gym.scoring.evaluation.run_episodes` scores those of an
    estimator: by the same functions, into rows of the same format.

    Args:
        game: the game of which the estimates are.
        submission: the estimates.
        results: the stored rows, and the file to which new rows are appended.
        progress: called after each batch with its number of episodes.
    """
    system = game.source.system

    def replay(seeds: Sequence[int]) -> Played:
        chosen = [submission.seeds.index(seed) for seed in seeds]
        xhat, P = submission.estimates.xhat[chosen], submission.estimates.P
        given = Estimates(xhat, None if P is None else P[chosen])
        return play(game, _Replay(system, given=given), seeds)

    common = {**game_fields(game), **submission.fields()}
    return score_episodes(common, replay, submission.seeds, results, progress)


def check_name(name: str) -> None:
    """Check the name of a submission.

    Raises:
        ValueError: in one line, if it cannot stand in rows, or is that of an estimator here, tuned
            or not, or of a floor.
    """
    plain = name.partition(" (")[0].removesuffix(SUFFIX)
    if plain in ESTIMATORS.sources or plain in FLOORS:
        raise ValueError(f"name={name!r} is that of an estimator of this package; expected another")
    if not (is_name(name) and name.isprintable()):
        raise ValueError(f"name={name!r}; expected {NAME_EXPECTED}, printable")


def read_estimates(path: Path, game: Game, seeds: range) -> Estimates:
    """Read the estimates of all episodes from a table, in CSV or, by its suffix, in Parquet.

    Its columns, in any order, are ``episode``, ``t`` (as in the records), one per state by its
    name, and either none or all of ``<state>_std``, the standard deviations. It has a line for each
    sample of each episode; those of an episode are in the order of t, and episodes in any order.
    ``inf`` stands for an estimate that has diverged.

    Args:
        path: the file.
        game: the game of the records.
        seeds: of their episodes.

    Raises:
        ValueError: in one line that names the file, the line or the episode, and what was
            expected, if a column, an episode or a sample is missing, there are others, times are
            not those of the records, or a cell is not a number.
    """
    if seeds.stop > TRAINING_SEED:
        raise ValueError(
            f"episode {seeds.stop - 1} is one for training, whose truth is given away; scored are "
            f"those below {TRAINING_SEED}"
        )
    system, setup = game.source.system, game.source.setup
    cells = read_cells(path)
    stds = [f"{name}_std" for name in system.state_names]
    has_std = _check_columns(cells, ["episode", "t", *system.state_names], stds)
    order = match_samples(cells, seeds, setup.times[: setup.num_steps], float(setup.dt))
    shape = len(seeds), setup.num_steps, system.nx
    states = [finite_or_lost(cells, name) for name in system.state_names]
    xhat = np.stack(states, axis=1)[order].reshape(shape)
    if not has_std:
        return Estimates(xhat)
    std = np.stack([not_negative(cells, name) for name in stds], axis=1)[order].reshape(shape)
    P = np.zeros((*shape, system.nx))
    np.einsum("bkii->bki", P)[...] = std**2
    return Estimates(xhat, P)


def _check_columns(cells: Cells, needed: Sequence[str], optional: Sequence[str]) -> bool:
    """Check the names of the columns. Returns whether the optional ones are there.

    Raises:
        ValueError: in one line, if a column is missing, unknown or there twice.
    """
    path, names = cells.path, cells.names
    listed = ", ".join(needed)
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{path} has column {name!r} twice")
        if name not in (*needed, *optional):
            left = {n.lower(): n for n in (*needed, *optional) if n not in names}
            near = get_close_matches(name.lower(), left, 1)
            hint = f" (did you mean {left[near[0]]!r}?)" if near else ""
            raise ValueError(
                f"{path} has a column {name!r}{hint}; expected {listed} and, optionally, "
                f"{', '.join(optional)}"
            )
    missing = [name for name in needed if name not in names]
    given = [name for name in optional if name in names]
    missing += [name for name in optional if name not in names] if given else []
    if missing:
        raise ValueError(f"{path} has no column {', '.join(missing)}; it has {', '.join(names)}")
    return bool(given)
