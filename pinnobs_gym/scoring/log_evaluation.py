"""Evaluation of an estimator on sensor logs with reference states."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.scoring.evaluation import (
    Evaluated,
    Results,
    estimator_fields,
    make_estimator,
    score_episodes,
)
from pinnobs_gym.scoring.log_game import LogGame
from pinnobs_gym.scoring.log_playing import play_log
from pinnobs_gym.scoring.playing import Played
from pinnobs_gym.scoring.provenance import game_hash
from pinnobs_gym.scoring.row_format import SCHEMA, Row
from pinnobs_gym.scoring.table import Rows
from pinnobs_gym.scoring.tensorboard import log_episodes, log_summary
from pinnobs_gym.simulation.system import Setup, System
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.log import SILENT, Log

_LOGGER = logging.getLogger(__name__)


def evaluate_logs(
    estimator: BaseEstimator | type[BaseEstimator] | str,
    system: System | type[System] | str,
    logs: Sequence[str | Path],
    references: Sequence[str | Path],
    *,
    setup: Setup | None = None,
    columns: Sequence[str] = (),
    options: Mapping[str, Any] | None = None,
    results: Path | str | None = None,
    fresh: bool = False,
    tensorboard: Log = SILENT,
    progress: Callable[[int], None] | None = None,
) -> Rows:
    """Score an estimator on sensor logs of which reference states are known, such as those of a
    motion capture: what `pinnobs_gym.scoring.evaluation.evaluate` is for simulated episodes.

    Each log is an episode. Estimates are scored at the times of its reference that lie within the
    log, which may be between samples: nothing is interpolated, the estimate there is the
    estimator's own from the samples before it (of an offline estimator: from all samples). States
    without a reference do not count.

    Args:
        estimator: an instance, which keeps its own model; or a class, a name or ``module:Class``,
            which is instantiated with the model and the noise of ``setup``.
        system: the model, its class, or its name or ``module:Class``.
        logs: CSV files; see `pinnobs_gym.logs.reading.read_log`.
        references: a CSV file for each of them, with columns t and some of the states by name; see
            `pinnobs_gym.logs.reference.read_reference`.
        setup: the noise and the prior that estimators are told; the setup ``benchmark`` if None.
        columns: columns of the logs under other names or in other units.
        options: settings of an estimator that is instantiated here.
        results: a rows file to append to. Logs already in it, of the same samples and reference, of
            the same settings and code, are not run again: their rows are taken from it, which is
            logged as a warning.
        fresh: run all logs, also those in ``results``, whose rows are replaced.
        tensorboard: log of scalars, figures and hyperparameters.
        progress: called after each log with 1.

    Returns:
        The rows, in the order of the logs; a list of dicts with a method ``to_pandas``.

    Raises:
        ValueError: in one line, if a file cannot be read or does not fit the system, an option is
            unknown, or the estimator does not take the system or a log.
    """
    for name, paths in (("logs", logs), ("references", references)):
        if isinstance(paths, str | Path):
            raise ValueError(f"{name}={str(paths)!r}; expected a list of files")
    if isinstance(system, System):
        model, own = system, type(system).setups["benchmark"]
    else:
        model, own = SYSTEMS.resolve(system).configured()
    game = LogGame.of(model, setup or own, logs, references, columns)
    for note in game.notes:
        _LOGGER.warning(note)
    made = make_estimator(estimator, game, options or {})
    stored = None if results is None else Results(Path(results), fresh=fresh)
    evaluated = run_logs(game, made, stored, progress)
    if evaluated.reused:
        _LOGGER.warning(evaluated.reuse(Path(results or "")))
    log_episodes(tensorboard, evaluated.rows, evaluated.first_played)
    log_summary(tensorboard, evaluated.rows)
    return Rows(evaluated.rows)


def run_logs(
    game: LogGame,
    estimator: BaseEstimator,
    results: Results | None = None,
    progress: Callable[[int], None] | None = None,
) -> Evaluated:
    """Run and score the logs that are not stored yet, one by one.

    Args:
        game: the logs.
        estimator: the estimator to score.
        results: the stored rows, and the file to which new rows are appended.
        progress: called after each log with 1.
    """

    def play(episodes: Sequence[int]) -> Played:
        (episode,) = episodes
        return play_log(game, estimator, episode)

    def more(played: Played) -> list[Row]:
        return [_log_fields(game, played)]

    common = {**_game_fields(game), **estimator_fields(estimator, game)}
    return score_episodes(common, play, tuple(game.logs), results, progress, more, size=1)


def _game_fields(game: LogGame) -> Row:
    """Return the fields of rows that say which game was played: one that is always ranked."""
    return {
        "schema": SCHEMA,
        "kind": "score",
        **game.name._asdict(),
        "game_hash": game_hash(game.source),
        "ranked": True,
        "nx": game.source.system.nx,
    }


def _log_fields(game: LogGame, played: Played) -> Row:
    """Return the fields of a row that say which log was played, and how many states are known."""
    (episode,) = played.seeds
    log = game.logs[episode]
    known = int(played.scored.any(axis=(0, 1)).sum())
    return {"log": log.log.path.name, "reference": log.reference.name, "nx": known}
