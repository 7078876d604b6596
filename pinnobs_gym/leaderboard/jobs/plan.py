"""The jobs of a suite, and selection of those still to run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.applicable import applies
from pinnobs_gym.leaderboard.jobs.job import Job, called
from pinnobs_gym.leaderboard.jobs.time_limit import TIME_LIMIT
from pinnobs_gym.leaderboard.suites import Entry, Suite
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring.evaluation import StoredKey, stored_key
from pinnobs_gym.scoring.recency import LastUse
from pinnobs_gym.scoring.rows import Stored, episode_of, game_of
from pinnobs_gym.scoring.tuned import SUFFIX, tuned_settings
from pinnobs_gym.scoring.tuning import check_searchable
from pinnobs_gym.simulation.conditions import fitting
from pinnobs_gym.systems import SYSTEMS


def default_estimators() -> tuple[Entry, ...]:
    """Return all estimators that can be scored on unseen episodes, in all their variants, and also
    tuned if they declare settings to search."""
    entries = []
    for name, cls in ESTIMATORS.classes().items():
        if cls.needs_training is None or cls.track == "online":
            entries += [Entry(name, settings=settings) for settings in cls.variants]
            trained = cls.needs_training or cls.trains_on_record
            entries += [Entry(name, tuned=True)] if cls.tunable and not trained else []
    return tuple(entries)


def jobs_of(suite: Suite, folder: Path) -> list[Job]:
    """Return the jobs of a suite in a folder.

    An estimator has none in a game whose system it does not take, see `BaseEstimator.takes`, and a
    tuned one has none where no settings are stored with the system. Jobs
    with training come first, since they take longest. The others are ordered by game, since
    the references of episodes are cached from one job to the next. Estimators that train on each
    record play fewer episodes, with one job per episode.

    Raises:
        ValueError: in one line, naming the invalid value, before anything is run.
    """
    estimators = suite.estimators or default_estimators()
    chosen = [(entry, _class(suite, entry)) for entry in estimators]
    names = [_name(suite, entry, cls) for entry, cls in chosen]
    for name in names:
        if names.count(name) > 1:
            message = f"{name!r} stands for two; give each a label of its own"
            raise suite.wrong("estimators", message)
    quick, long = [], []
    for system in suite.systems or tuple(SYSTEMS.classes()):
        for planned, (entry, cls) in product(_planned_games(suite, system), chosen):
            if not applies(cls, planned.game):
                continue
            if entry.tuned:
                settings = tuned_settings(cls, planned.game)
                if settings is None:
                    continue
                entry = replace(entry, settings=settings)
            if cls.needs_training or cls.trains_on_record:
                if not planned.untrained_only:
                    long += _learning(suite, entry, cls, planned.game, folder)
            else:
                _check_settings(suite, entry, cls, planned.game, {})
                quick.append(_job(suite, entry, planned.game, folder, settings=entry.settings))
    _check_tuned(suite, [*long, *quick])
    return long + quick


@dataclass(frozen=True)
class PlannedGame:
    """A game, and which estimators play it."""

    game: Game
    untrained_only: bool
    """Whether only estimators that need no training play it."""


def _job(suite: Suite, entry: Entry, game: Game, folder: Path, **more: Any) -> Job:
    return Job(
        game=game,
        estimator=entry.name,
        episodes=1 if game.source.deterministic else suite.episodes,
        seed=suite.seed,
        folder=folder,
        label=entry.label,
        time_limit=_time_limit(suite, more.get("training", {})),
        **more,
    )


def _time_limit(suite: Suite, training: Mapping[str, Any]) -> float:
    """Return the time limit of a job in s: that of the suite or, if it has none, a generous one,
    with four times the CPU seconds of its training."""
    if suite.timeout is not None:
        return suite.timeout
    return TIME_LIMIT + 4 * float(training.get("budget") or 0)


def _learning(
    suite: Suite, entry: Entry, cls: type[BaseEstimator], game: Game, folder: Path
) -> Iterator[Job]:
    """Yield the jobs of a trained estimator: one per budget and training seed or, if it trains on
    each record, also one per episode."""
    seeds = [{"seed": seed} for seed in suite.training_seeds] or [{}]
    for budget, seed in product(suite.budgets, seeds):
        training = {"budget": budget, **seed, **entry.settings}
        _check_settings(suite, entry, cls, game, training)
        job = _job(suite, entry, game, folder, training=training)
        if cls.trains_on_record is None:
            yield job
        else:
            for i in range(min(job.episodes, suite.trained_episodes)):
                yield replace(job, episodes=1, seed=suite.seed + i)


def left(jobs: Sequence[Job], stored: Stored, retry_failed: bool) -> tuple[list[Job], list[Job]]:
    """Return the jobs to run, with the keys of their stored rows, and the jobs left out because
    they failed before; with ``retry_failed`` the latter are run again."""
    known_rows: dict[tuple[GameName, str], list[StoredKey]] = defaultdict(list)
    for row in stored.rows:
        known_rows[game_of(row), row["estimator"]].append(stored_key(row))
    last_use = LastUse.of([*stored.rows, *stored.uses])
    failed = {row["job"] for row in stored.failures}
    to_run, left_out = [], []
    for job in jobs:
        again = bool(failed) and job.digest in failed  # a digest reads the code of a whole game
        if again and not retry_failed:
            left_out.append(job)
            continue
        known = None  # the name in rows may be another one: the job reads the file itself
        cls = ESTIMATORS.resolve(job.estimator)
        if job.label is not None or cls.label is BaseEstimator.label:
            keys = known_rows[job.game.name, job.called]
            wanted = set(map(episode_of, range(job.seed, job.seed + job.episodes)))
            known = frozenset(entry for entry in keys if entry[-1] in wanted)
        own = last_use.among(job.game.name)
        to_run.append(replace(job, known=known, last_use=own, failed=again))
    return to_run, left_out


def _check_tuned(suite: Suite, jobs: Sequence[Job]) -> None:
    """Check that each tuned estimator that a suite lists has a job in some game."""
    for entry in suite.estimators:
        name = entry.label or called(ESTIMATORS.resolve(entry.name), {}) + SUFFIX
        if entry.tuned and name not in {job.called for job in jobs}:
            message = (
                f"no tuned settings of {entry.name!r} are stored with any of the systems for setup "
                f"{suite.setup!r}; they are found by: pinnobs tune {entry.name} --store"
            )
            raise suite.wrong("estimators", message)


def _class(suite: Suite, entry: Entry) -> type[BaseEstimator]:
    try:
        cls = ESTIMATORS.resolve(entry.name)
        if cls.needs_training is not None and cls.track == "offline":
            raise ValueError(f"estimator {entry.name!r} knows one record; it cannot be ranked")
        if entry.tuned:
            check_searchable(cls)
    except ValueError as error:
        raise suite.wrong("estimators", error) from error
    if cls.needs_training or cls.trains_on_record:
        try:
            trainer_class(cls)
        except ValueError as error:
            raise suite.wrong("estimators", f"trainer of {entry.name!r}: {error}") from error
    return cls


def _name(suite: Suite, entry: Entry, cls: type[BaseEstimator]) -> str:
    """Return the name in rows of a suite's estimator."""
    try:
        return entry.label or called(cls, entry.settings) + (SUFFIX if entry.tuned else "")
    except (ValueError, TypeError) as error:
        raise suite.wrong("estimators", f"settings of {entry.name!r}: {error}") from error


def _planned_games(suite: Suite, system: str) -> list[PlannedGame]:
    """Return the games of a system in a suite."""
    try:
        cls = SYSTEMS.resolve(system)
    except ValueError as error:
        raise suite.wrong("systems", error) from error
    try:
        model, setup = cls.configured(suite.setup)
    except ValueError as error:
        raise suite.wrong("setup", error) from error
    if "all" in suite.conditions and len(suite.conditions) > 1:
        message = f"conditions {' '.join(suite.conditions)}: 'all' stands alone"
        raise suite.wrong("conditions", message)
    ranked = list(dict.fromkeys(["nominal", cls.ranked_condition]))
    if suite.conditions == ("all",):
        names = dict.fromkeys([*ranked, *fitting(model, setup)])
    else:
        names, ranked = suite.conditions or ranked, list(suite.conditions or ranked)
    planned: dict[GameName, PlannedGame] = {}
    for name in names:
        try:
            game = Game.of(cls, suite.setup, name)
        except ValueError as error:
            raise suite.wrong("conditions", f"{name!r} on {system}: {error}") from error
        planned[game.name] = PlannedGame(game, name not in ranked)
    return list(planned.values())


def _check_settings(
    suite: Suite,
    entry: Entry,
    cls: type[BaseEstimator],
    game: Game,
    training: Mapping[str, Any],
) -> None:
    """Check the settings of an estimator, or those of its trainer."""
    try:
        if cls.needs_training or cls.trains_on_record:
            cls.trainer_config(training)
            return
        cls.for_setup(game.source.system, game.source.setup, **entry.settings)
    except (ValueError, TypeError) as error:
        message = f"settings of {entry.name!r}: {error}"
        raise suite.wrong("estimators" if entry.settings else "budgets", message) from error
    except KeyboardInterrupt:
        raise
    except BaseException:  # of a plug-in that cannot be made at all: its jobs fail
        return
