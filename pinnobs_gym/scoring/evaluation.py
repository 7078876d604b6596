"""Evaluation of an estimator, episode by episode."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any, TypeAlias

from pinnobs_gym.envs.game import AnyGame, Game
from pinnobs_gym.envs.policy import is_policy, policy_of
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import CannotWrite
from pinnobs_gym.registry import TRAINERS, trainer_class
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.curves import curves_of, folder_of, save
from pinnobs_gym.scoring.deviations import deviations
from pinnobs_gym.scoring.identifiability import Identifiability, identifiability
from pinnobs_gym.scoring.playing import Played, play
from pinnobs_gym.scoring.provenance import (
    canonical,
    estimator_code,
    estimator_hash,
    game_hash,
    now,
    versions,
)
from pinnobs_gym.scoring.recency import LastUse
from pinnobs_gym.scoring.row_format import (
    FLOOR,
    FLOOR_WHOLE,
    LAST_SEED,
    MOST_EPISODES,
    NEEDED,
    OPTIONAL,
    SCHEMA,
    Row,
    check_names,
)
from pinnobs_gym.scoring.table import Rows
from pinnobs_gym.scoring.tensorboard import log_episodes, log_summary
from pinnobs_gym.scoring.tuned import SUFFIX, TUNED, is_tuned, required_settings
from pinnobs_gym.simulation.conditions import canonical_name
from pinnobs_gym.simulation.notices import say_first
from pinnobs_gym.simulation.system import System
from pinnobs_gym.simulation.values import is_finite, shortly
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import LOGS
from pinnobs_gym.training.log import SILENT, Log
from pinnobs_gym.training.progress import shown_progress

BATCH = 256
"""Number of episodes run together."""
_LOGGER = logging.getLogger(__name__)


StoredKey: TypeAlias = tuple[str, str, int | None, int]
"""What identifies a row among those of one estimator's name in one game: ``game_hash``,
``estimator_hash``, ``training_seed`` and ``episode``."""
stored_key: Callable[[Row], StoredKey] = itemgetter(
    "game_hash", "estimator_hash", "training_seed", "episode"
)
"""Return the `StoredKey` of a row."""


@dataclass(frozen=True)
class Results:
    """A rows file to which scores are appended."""

    path: Path
    known: frozenset[StoredKey] | None = None
    """The stored rows of the same estimator and game; if None, the file is read."""
    fresh: bool = False
    """Whether episodes are run again even if they are stored; the new rows replace the old."""
    last_use: LastUse | None = None
    """When the code of the same game was used last; if ``known`` is None, the file tells."""

    def stored(self, wanted: Sequence[Row]) -> dict[tuple[Any, ...], Row]:
        """Return those of the wanted rows that are stored, by their key. Their scores are included
        only if the file is read."""
        if self.fresh:
            return {}
        if self.known is None:
            return {rows_module.key(row): row for row in rows_module.read(self.path)}
        stored = (row for row in wanted if stored_key(row) in self.known)
        return {rows_module.key(row): row for row in stored}

    def is_ahead(self, stored: Iterable[Row], date: str) -> bool:
        """Return whether a row of other code may be later than a date, as after a clock has gone
        back."""
        known = [] if self.last_use is None else self.last_use.games.values()
        return any(each > date for each in (*known, *(row.get("date", "") for row in stored)))

    def note_use(self, common: Row) -> None:
        """Append that the code of these rows is the present one, if other code was used later."""
        last_use = self.last_use
        if self.known is None or last_use is None:
            stored = rows_module.load(self.path)
            last_use = LastUse.of([*stored.rows, *stored.uses])
        if not last_use.is_last(common):
            used = {name: common[name] for name in NEEDED["use"] if name in common}
            use = {"schema": SCHEMA, "kind": "use", **used, "date": now(last_use.latest)}
            rows_module.append(self.path, [use])


def evaluate(
    estimator: BaseEstimator | type[BaseEstimator] | str | Any,
    env_id: str,
    *,
    episodes: int = 100,
    seed: int = 0,
    setup: str = "benchmark",
    condition: str = "nominal",
    options: Mapping[str, Any] | None = None,
    tuned: bool = False,
    results: Path | str | None = None,
    fresh: bool = False,
    log: Log = SILENT,
    progress: bool | Callable[[int], None] = False,
) -> Rows:
    """Score an estimator on the episodes of an env.

    All estimators get the same episodes: that of seed s is the first episode of the single env
    reset with seed s. The estimates x̂(k|k) are scored against the states x_k, as in the env's
    reward (`pinnobs_gym.scoring.metrics.score`).

    Args:
        estimator: an instance, which keeps its own model; or a class, a name or ``module:Class``,
            which is instantiated with the env's model and noise; or a policy: a model of
            Stable-Baselines3, or a function of observations (batch, features) that returns actions
            (see `pinnobs_gym.envs.policy.policy_of`).
        env_id: such as ``pinnobs/ReverseDuffing-v0``; or the name of the system.
        episodes: number of episodes, of seeds seed, seed + 1, ...
        seed: of the first episode.
        setup: ``benchmark`` or ``paper``.
        condition: change of the episodes relative to the setup, such as ``load_step`` or
            ``noise5+dropout10``.
        options: settings of an estimator that is instantiated here; of a policy ``action_mode``,
            ``stack_outputs``, ``normalize`` and ``title``.
        tuned: whether it has the settings that are stored with the system, see
            `pinnobs_gym.scoring.tuned`, in place of ``options``.
        results: a rows file to append to, in whole batches. Episodes already in it, of the same
            settings and the same code of estimator, system, simulation and scores, are not run
            again: their rows are taken from it, which is logged as a warning. Curves for figures
            are written to a folder beside it.
        fresh: run all episodes, also those in ``results``, whose rows are replaced.
        log: TensorBoard log of scalars, figures and hyperparameters.
        progress: whether to show a progress bar in a terminal, or elsewhere a line now and then; or
            a function, called after each batch with its number of episodes.

    Returns:
        The rows, in the order of seeds; a list of dicts with a method ``to_pandas``.

    Raises:
        ValueError: in one line, for an unknown id, setup, condition or option, an estimator whose
            model does not match the env, or tuned settings that are not stored.
    """
    game = Game.of(env_id, setup, condition)
    made = make_estimator(estimator, game, options or {}, tuned)
    stored = None if results is None else Results(Path(results), fresh=fresh)
    play_all = partial(run_episodes, game, made, seeds_of(seed, episodes), stored)
    evaluated = _with_progress(episodes, play_all, progress)
    if evaluated.reused:
        _LOGGER.warning(evaluated.reuse(Path(results or "")))
    log_episodes(log, evaluated.rows, evaluated.first_played)
    log_summary(log, evaluated.rows)
    return Rows(evaluated.rows)


def _with_progress(
    episodes: int, play_all: Callable[..., Evaluated], progress: bool | Callable[[int], None]
) -> Evaluated:
    """Return what ``play_all`` scores, with its progress shown if asked for."""
    if not isinstance(progress, bool):
        return play_all(progress)
    if not progress:
        return play_all()
    with shown_progress() as show:
        done, doing = 0, ""

        def said(now: str) -> None:
            nonlocal doing
            doing = now
            show(done / episodes, f"{done} of {episodes} episodes, {doing}")

        def count(more: int) -> None:
            nonlocal done
            done += more
            show(done / episodes, f"{done} of {episodes} episodes")

        return play_all(count, phase=said)


def seeds_of(seed: int, episodes: int) -> range:
    """Return the seeds of a number of episodes, given the first.

    Raises:
        ValueError: in one line, if the number of episodes is not from 1 to `MOST_EPISODES` or a
            seed not from 0 to `LAST_SEED`, or one of them is not a whole number.
    """
    for name, value, least in (("episodes", episodes, 1), ("seed", seed, 0)):
        if not is_finite(value) or int(value) != value:
            raise ValueError(f"{name}={shortly(value)}; expected a whole number")
        if value < least:
            raise ValueError(f"{name}={value}; expected at least {least}")
    if episodes > MOST_EPISODES:
        raise ValueError(f"episodes={episodes}; expected at most {MOST_EPISODES}")
    if seed + episodes - 1 > LAST_SEED:
        raise ValueError(f"seed={seed}; expected seeds of at most {LAST_SEED}")
    return range(int(seed), int(seed) + int(episodes))


@dataclass(frozen=True)
class Evaluated:
    """The result of an evaluation."""

    rows: list[Row]
    """The rows in the order of seeds, or of logs. Rows known to be stored but not read have no
    scores."""
    first_played: Played | None
    """The first batch that was run; None if all episodes were stored."""
    reused: int
    """Number of episodes that were stored."""

    def reuse(self, path: Path) -> str:
        """Return in words how many episodes were taken from the rows file."""
        return f"{self.reused} of {len(self.rows)} episodes taken from {path}"


@dataclass(frozen=True)
class StandIn:
    """What plays in the place of an estimator that trains on each record: the result of a training
    that took place earlier, on the same record."""

    estimator: BaseEstimator
    """The estimator with this result."""
    seconds: float
    """CPU seconds of the training, which are part of the cost of the estimates."""
    code: Mapping[str, str]
    """``estimator_code`` and ``estimator_hash`` of the rows of the training."""

    def play(self, game: Game, seeds: Sequence[int]) -> Played:
        """Run it on episodes, with the training as part of the cost; see `play`."""
        played = play(game, self.estimator, seeds)
        training = self.seconds * 1e6 / (played.record.num_samples * played.record.batch)
        return replace(played, us_per_step=played.us_per_step + training)


def run_episodes(
    game: Game,
    estimator: BaseEstimator,
    seeds: range,
    results: Results | None = None,
    progress: Callable[[int], None] | None = None,
    label: str | None = None,
    stand_in: StandIn | None = None,
    phase: Callable[[str], None] | None = None,
) -> Evaluated:
    """Run and score the episodes that are not stored yet, batch by batch.

    Args:
        game: what is played.
        estimator: the estimator to score.
        seeds: of the episodes.
        results: the stored rows, and the file to which new rows are appended.
        progress: called after each batch with its number of episodes.
        label: name of the estimator in rows; its own if None.
        stand_in: what plays in its place; rows have the code that this was trained by.
        phase: called with what is done from then on.
    """
    common = {**game_fields(game), **estimator_fields(estimator, game)}
    if stand_in is not None:
        common |= stand_in.code
    if label is not None:  # which stands for the settings
        told = {"estimator": ESTIMATORS.spec_of(type(estimator)), "settings": common["settings"]}
        common |= {"estimator": label, "settings": {}}
        common["made_by"] = {**common.get("made_by", {}), **told}
    plays = partial(play, game, estimator, phase=phase)
    if stand_in is not None:
        plays = partial(stand_in.play, game)
    return score_episodes(common, plays, seeds, results, progress)


def score_episodes(
    common: Row,
    play_batch: Callable[[Sequence[int]], Played],
    seeds: Sequence[int],
    results: Results | None = None,
    progress: Callable[[int], None] | None = None,
    more: Callable[[Played], list[Row]] | None = None,
    size: int = BATCH,
) -> Evaluated:
    """Score the episodes that are not stored yet, batch by batch.

    Args:
        common: the fields that all rows have in common. They take precedence over those that are
            found here, such as the cost.
        play_batch: returns the episodes of some seeds with the estimates.
        seeds: of the episodes.
        results: the stored rows, and the file to which new rows are appended.
        progress: called after each batch with its number of episodes.
        more: returns further fields of the rows of a batch.
        size: number of episodes of a batch.

    Raises:
        ValueError: in one line, if a name in the rows is empty, too long or has white space at its
            ends.
    """
    check_names(common)
    wanted = [{**common, "episode": rows_module.episode_of(seed)} for seed in seeds]
    stored = {} if results is None else results.stored(wanted)
    missing = [row for row in wanted if rows_module.key(row) not in stored]
    first_played = None
    noted = results is not None and (not missing or results.is_ahead(stored.values(), now()))
    for first in range(0, len(missing), size):
        batch = missing[first : first + size]
        played = play_batch([rows_module.seed_of(row) for row in batch])
        first_played = first_played or played
        scored = zip(batch, _scored(played), strict=True)
        done = [{**dict.fromkeys(OPTIONAL), **row, **scores, **common} for row, scores in scored]
        if more is not None:
            done = [{**row, **further} for row, further in zip(done, more(played), strict=True)]
        if results is not None:
            # Curves first: if a crash follows, episodes without rows are run again.
            _save_curves(results.path, done[0], played)
            rows_module.append(results.path, done, replace=results.fresh)
        stored.update({rows_module.key(row): row for row in done})
        if progress is not None:
            progress(len(done))
    if results is not None and noted:
        results.note_use(common)
    rows = [stored[rows_module.key(row)] for row in wanted]
    return Evaluated(rows, first_played, len(wanted) - len(missing))


def _save_curves(results: Path, row: Row, played: Played) -> None:
    """Save the errors over time beside a rows file. Scores do not depend on them: if they cannot be
    written, a line is logged, once in each process."""
    try:
        save(folder_of(results), row, curves_of(played))
    except CannotWrite as error:
        say_first("curves", f"{error}; scores are stored without these errors over time")


def _scored(played: Played) -> list[Row]:
    """Return the scores of each episode by name, with the computational cost."""
    cost = {"us_per_step": played.us_per_step, "batch": played.record.batch, "date": now()}
    return [scores | cost for scores in played.scores.rows()]


def make_estimator(
    estimator: BaseEstimator | type[BaseEstimator] | str | Any,
    game: AnyGame,
    options: Mapping[str, Any],
    tuned: bool = False,
) -> BaseEstimator:
    """Return the estimator that a name, a class or an instance denotes in a game, with its tuned
    settings if ``tuned``.

    Raises:
        ValueError: in one line, if it is unknown, has to be trained first, does not accept the
            options, has no tuned settings, or has another model than the game's.
    """
    if tuned and (options or isinstance(estimator, BaseEstimator)):
        given = f"options {dict(options)}" if options else "an instance"
        raise ValueError(f"tuned settings and {given}; expected one of them")
    system, setup = game.source.system, game.source.setup
    if isinstance(estimator, BaseEstimator):
        if options:
            raise ValueError(f"options {dict(options)} go with a name or a class, not an instance")
        _check_model(estimator.system, system)
        return estimator
    if is_policy(estimator):
        return _policy(estimator, game, options)
    cls = ESTIMATORS.resolve(estimator)
    if tuned:
        options = required_settings(cls, game)
    if cls.needs_training is not None:
        name = ESTIMATORS.name_of(cls)
        trainer = TRAINERS.spec_of(trainer_class(cls))
        raise ValueError(f"estimator {name!r} has to be trained first: pinnobs train {trainer}")
    try:
        return cls.for_setup(system, setup, **options)
    except TypeError as error:
        raise ValueError(f"estimator {ESTIMATORS.name_of(cls)!r}: {error}") from None


def _policy(policy: Any, game: AnyGame, options: Mapping[str, Any]) -> BaseEstimator:
    """Return a policy as an estimator of a game; see `make_estimator`."""
    if not isinstance(game, Game):
        raise ValueError("a policy plays simulated episodes; expected an estimator for a log")
    known = ("action_mode", "stack_outputs", "normalize", "title")
    for name in options:
        if name not in known:
            raise ValueError(f"option {name!r} of a policy; expected one of {', '.join(known)}")
    source = game.source
    lossy = source.condition.loses_outputs
    return policy_of(policy, source.system, source.setup, loses_outputs=lossy, **options)


def _check_model(model: System, system: System) -> None:
    found, expected = (
        f"{type(each).__name__} (nx={each.nx}, ny={each.ny})" for each in (model, system)
    )
    if found != expected:
        raise ValueError(f"the estimator's model is {found}; that of the game is {expected}")


def _identifiability(game: Game) -> Row:
    """Return how a condition enlarges errors, as fields of rows; None where it does not."""
    names = [f.name for f in fields(Identifiability)]
    found = identifiability(game)
    return dict.fromkeys(names) if found is None else asdict(found)


def game_fields(game: Game) -> Row:
    """Return the fields of rows that say which game was played."""
    system = game.source.system
    return {
        "schema": SCHEMA,
        "kind": "score",
        **game.name._asdict(),
        "game_hash": game_hash(game.source),
        "ranked": game.name.condition == canonical_name(system.ranked_condition),
        "nx": system.nx,
        **_identifiability(game),
    }


def estimator_fields(estimator: BaseEstimator, game: AnyGame) -> Row:
    """Return the fields of rows that say which estimator was run."""
    condition = game.name.condition
    # An estimator trained under the very condition that is scored is no match for the others.
    informed = condition != "nominal" and estimator.training.get("condition") == condition
    knows = [*estimator.knows, *estimator.training.get("knows", ())]
    knows += ["condition"] if informed else []
    knows += [LOGS] if estimator.training.get("condition") == LOGS else []
    tuned = is_tuned(type(estimator), estimator.options, game)
    knows += [TUNED] if tuned else []
    made_by = _made_by(estimator, game)
    return {
        "estimator": estimator.label + (SUFFIX if tuned else ""),
        "track": f"{estimator.track}, condition known" if informed else estimator.track,
        "knows": list(dict.fromkeys(knows)),
        "options": canonical(estimator.options),
        "settings": deviations(estimator, game),
        "estimator_code": estimator_code(type(estimator)),
        "estimator_hash": estimator_hash(estimator),
        "training": canonical(estimator.training),
        "training_seed": estimator.training.get("seed"),
        **({"made_by": made_by} if made_by else {}),
        "versions": versions(),
    }


def _made_by(estimator: BaseEstimator, game: AnyGame) -> dict[str, str]:
    """Return what commands take for an estimator and a system that the package does not have."""
    cls, system = type(estimator), type(game.source.system)
    found = {}
    if cls.track not in (FLOOR, FLOOR_WHOLE) and ESTIMATORS.spec_of(cls) != ESTIMATORS.name_of(cls):
        found["estimator"] = ESTIMATORS.spec_of(cls)
    if SYSTEMS.spec_of(system) != SYSTEMS.name_of(system):
        found["system"] = SYSTEMS.spec_of(system)
    return found
