"""Scoring an estimator episode by episode."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pinnobs_gym.envs.registration import make_vector_env
from pinnobs_gym.envs.vector_env import EstimationVectorEnv
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.curves import folder_of, save
from pinnobs_gym.scoring.playing import play_batch
from pinnobs_gym.scoring.provenance import canonical, versions
from pinnobs_gym.scoring.rows import SCHEMA, Row
from pinnobs_gym.scoring.tensorboard import log_episodes, log_summary
from pinnobs_gym.simulation.conditions import canonical_name
from pinnobs_gym.training.log import SILENT, Log

BATCH = 256
"""Episodes that are run at a time."""


@dataclass(frozen=True)
class Results:
    """A rows file that scores are appended to."""

    path: Path
    known: frozenset[tuple[str, int | None, int]] | None = None
    """(config_hash, training_seed, episode_seed) of what is there already of the same estimator and
    game; None if the file is to be read for that."""

    def stored(self, wanted: Sequence[Row]) -> dict[tuple[Any, ...], Row]:
        """Those of the wanted rows that are there already, by what names them; as they are in the
        file, if it is read."""
        if self.known is None:
            return {rows_module.key(row): row for row in rows_module.read(self.path)}
        there = (row for row in wanted if rows_module.key(row)[4:] in self.known)
        return {rows_module.key(row): row for row in there}


def evaluate(
    estimator: Estimator | type[Estimator] | str,
    env_id: str,
    *,
    episodes: int = 100,
    seed: int = 0,
    setup: str = "benchmark",
    condition: str = "nominal",
    options: Mapping[str, Any] | None = None,
    results: Path | str | None = None,
    log: Log = SILENT,
    progress: Callable[[int], None] | None = None,
) -> list[Row]:
    """Score an estimator on an env's episodes.

    All estimators see the same episodes: that of seed s is the first of the single env reset with
    seed s. The env is stepped with the estimates, x̂(k|k) against x_k, and its states are scored
    (`pinnobs_gym.scoring.metrics.score`).

    Args:
        estimator: an instance, whose own model is then used; or a class, a name or
            ``module:Class``, which is then made for the env's model and noise.
        env_id: such as ``pinnobs/ReverseDuffing-v0``.
        episodes: how many, of seeds seed, seed + 1, ...
        seed: of the first episode.
        setup: ``benchmark`` or ``paper``.
        condition: how episodes depart from the setup, such as ``load_step`` or
            ``noise5+dropout10``.
        options: settings of an estimator that is made here.
        results: a rows file to append to, in whole batches; episodes already in it are not run
            again, and their rows are taken from it. Curves for pictures go to a folder beside it.
        log: where scalars, figures and hyperparameters go for TensorBoard.
        progress: called with the number of episodes done.

    Returns:
        The rows, in the order of seeds.

    Raises:
        ValueError: in one line, for an unknown id, setup, condition or option, or an estimator
            whose model does not fit the env.
    """
    result, made, example = run_episodes(
        estimator,
        env_id,
        range(seed, seed + episodes),
        setup,
        condition,
        options,
        None if results is None else Results(Path(results)),
        progress,
    )
    log_episodes(log, result, made, example)
    log_summary(log, result)
    return result


def run_episodes(
    estimator: Estimator | type[Estimator] | str,
    env_id: str,
    seeds: range,
    setup: str,
    condition: str,
    options: Mapping[str, Any] | None = None,
    results: Results | None = None,
    progress: Callable[[int], None] | None = None,
    label: str | None = None,
) -> tuple[list[Row], Estimator, dict[str, Any] | None]:
    """What `evaluate` does but for logging; returns also the estimator that was scored, and the
    seed of the first episode that was run, if any was, with what `state_figure` draws of it. Rows
    that are only known to be stored have no scores. The label is the estimator's name in rows, if
    not its own."""
    if not len(seeds):
        raise ValueError(f"episodes={len(seeds)}; expected at least 1")
    if seeds[0] < 0:
        raise ValueError(f"seed={seeds[0]}; expected at least 0")
    condition = canonical_name(condition)
    env = make_vector_env(env_id, 1, setup, condition)
    made = _make(estimator, env, options or {})
    common = _common(made, env, env_id, setup, condition)
    common["estimator"] = label or made.label
    wanted = [{**common, "episode_seed": seed} for seed in seeds]
    stored = {} if results is None else results.stored(wanted)
    missing = [row for row in wanted if rows_module.key(row) not in stored]
    example = None
    for first in range(0, len(missing), BATCH):
        batch = missing[first : first + BATCH]
        seeds_now = [row["episode_seed"] for row in batch]
        scored, first_played, curves = play_batch(made, env_id, setup, condition, seeds_now)
        if example is None:
            example = {"seed": seeds_now[0], **first_played}
        done = [{**row, **scores} for row, scores in zip(batch, scored, strict=True)]
        if results is not None:
            # Curves first: episodes that have rows are not run again.
            save(folder_of(results.path), done[0], curves)
            rows_module.append(results.path, done, new=made.trains_on_record is not None)
        stored.update({rows_module.key(row): row for row in done})
        if progress is not None:
            progress(len(done))
    return [stored[rows_module.key(row)] for row in wanted], made, example


def _make(
    estimator: Estimator | type[Estimator] | str,
    env: EstimationVectorEnv,
    options: Mapping[str, Any],
) -> Estimator:
    system, setup = env.source.system, env.source.setup
    if isinstance(estimator, Estimator):
        if options:
            raise ValueError(f"options {dict(options)} go with a name or a class, not an instance")
        model = estimator.system
        if (type(model).__name__, model.nx, model.ny) != (
            type(system).__name__,
            system.nx,
            system.ny,
        ):
            raise ValueError(
                f"the estimator's model is {type(model).__name__} (nx={model.nx}, ny={model.ny}); "
                f"the env plays {type(system).__name__} (nx={system.nx}, ny={system.ny})"
            )
        return estimator
    cls = ESTIMATORS.resolve(estimator)
    if cls.needs_training is not None:
        name = ESTIMATORS.name_of(cls)
        raise ValueError(
            f"estimator {name!r} has to be trained first: pinnobs train {cls.needs_training}"
        )
    try:
        return cls.for_setup(system, setup, **options)
    except TypeError as error:
        raise ValueError(f"estimator {ESTIMATORS.name_of(cls)!r}: {error}") from None


def _common(
    estimator: Estimator, env: EstimationVectorEnv, env_id: str, setup: str, condition: str
) -> Row:
    """What all rows of an evaluation share."""
    identity = {
        "class": f"{type(estimator).__module__}.{type(estimator).__qualname__}",
        "model": canonical(estimator.system),
        "noise_std": canonical(estimator.noise_std),
        "options": canonical(estimator.options),
        "training": {k: v for k, v in canonical(estimator.training).items() if k != "seconds"},
        "played": canonical(env.source.setup),
    }
    text = json.dumps(identity, sort_keys=True)
    return {
        "schema": SCHEMA,
        "kind": "score",
        "env_id": env_id,
        "setup": setup,
        "condition": condition,
        "ranked": condition == canonical_name(env.source.system.ranked_condition),
        "nx": env.source.system.nx,
        "estimator": estimator.label,
        "track": estimator.track,
        "knows": list(estimator.knows),
        "options": canonical(estimator.options),
        "config_hash": hashlib.sha256(text.encode()).hexdigest()[:12],
        "training": canonical(estimator.training),
        "training_seed": estimator.training.get("seed"),
        "versions": versions(),
    }
