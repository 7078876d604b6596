"""Scoring an estimator episode by episode."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from datetime import UTC, datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from pinnobs_gym import rows as rows_module
from pinnobs_gym.bound import cramer_rao, expected_scores, step_error
from pinnobs_gym.conditions import canonical_name
from pinnobs_gym.consistency import consistency
from pinnobs_gym.curves import Curves, Example, curves_of, folder_of, save
from pinnobs_gym.env import EstimationVectorEnv
from pinnobs_gym.episodes import EpisodeSource, Stream
from pinnobs_gym.estimator import Estimates, Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.figures import state_figure
from pinnobs_gym.log import SILENT, Log
from pinnobs_gym.metrics import OPTIONAL_SCORES, by_sample, score
from pinnobs_gym.rows import SCHEMA, Row
from pinnobs_gym.system import System, vector

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
    (`pinnobs_gym.metrics.score`).

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


def make_vector_env(
    env_id: str, num_envs: int, setup: str, condition: str, **changes: Any
) -> EstimationVectorEnv:
    """The vectorised env of that id; ``changes`` are further settings of it, such as noise_std.

    Raises:
        ValueError: listing the valid ids, if it is unknown.
    """
    known = [name for name in gym.registry if name.startswith("pinnobs/")]
    if env_id not in known:
        raise ValueError(f"unknown env id {env_id!r}; known are {', '.join(sorted(known))}")
    env = gym.make_vec(
        env_id,
        num_envs,
        vectorization_mode="vector_entry_point",
        setup=setup,
        condition=condition,
        **changes,
    ).unwrapped
    assert isinstance(env, EstimationVectorEnv)
    return env


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


def score_batch(
    estimator: Estimator,
    env_id: str,
    setup: str,
    condition: str,
    seeds: list[int],
    reset_options: dict[str, Any] | None = None,
    **changes: Any,
) -> tuple[list[Row], dict[str, Any]]:
    """The scores of the episodes of these seeds, and the first of them for a picture; the env is
    made with the changes and reset with the options."""
    return play_batch(estimator, env_id, setup, condition, seeds, reset_options, **changes)[:2]


def play_batch(
    estimator: Estimator,
    env_id: str,
    setup: str,
    condition: str,
    seeds: list[int],
    reset_options: dict[str, Any] | None = None,
    **changes: Any,
) -> tuple[list[Row], dict[str, Any], Curves]:
    """What `score_batch` returns, and the curves of all episodes."""
    env = make_vector_env(env_id, len(seeds), setup, condition, **changes)
    _, infos = env.reset(seed=seeds, options=reset_options)
    record = env.record()
    start = time.process_time()
    estimates = estimator.run(record)
    cost = (time.process_time() - start) / (record.num_samples * record.batch) * 1e6
    xhat = _checked(estimates, estimator, (record.batch, record.num_samples, env.source.system.nx))
    x = np.empty_like(xhat)
    bounded = np.where(np.isfinite(xhat), xhat, 0.0)  # a row that is not finite is scored as such
    for k in range(record.num_samples):
        x[:, k] = infos["state"]
        *_, infos = env.step(bounded[:, k])
    system = env.source.system
    scores = score(
        record.t,
        x,
        xhat,
        system.scale,
        scored=system.observable(x),
        alternatives=system.indistinguishable(x),
    )
    optional = consistency(x, estimates, np.isnan(record.y))
    reference = None
    if reset_options is None and not changes:
        reference = _reference(type(system), setup, condition, tuple(seeds))
        for name, whole in (("reference_ratio", "nrmse"), ("reference_ratio_tail", "nrmse_tail")):
            ratio = None if reference is None else scores[f"{whole}_modulo"] / reference[whole]
            optional[name] = ratio
    cost_now = {"us_per_step": cost, "batch": record.batch, "date": now()}
    rows = [
        {name: values[i].item() for name, values in scores.items()}
        | {name: _number_of(optional.get(name), i) for name in OPTIONAL_SCORES}
        | cost_now
        for i in range(record.batch)
    ]
    P = None if estimates.P is None else estimates.P[0]
    example = {"t": record.t, "xhat": xhat[0], "x": x[0], "y": record.y[0], "P": P}
    std = None if P is None else np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2), 0))
    curves = curves_of(
        system,
        seeds,
        record.t,
        by_sample(xhat - x, system.scale, system.observable(x)),
        None if reference is None else reference["by_sample"],
        Example(seeds[0], record.t, x[0], xhat[0], record.y[0], std),
    )
    return rows, example, curves


@lru_cache(maxsize=8)
def _reference(
    system: type[System], setup: str, condition: str, seeds: tuple[int, ...]
) -> dict[str, np.ndarray] | None:
    """What `expected_scores` says of the Cramér-Rao reference of these episodes, (batch,) each, NaN
    where it is below what a single step of the model errs by; and as ``by_sample`` what is expected
    of each sample, (batch, num_samples). None where there is none: without noise, from a fixed
    initial state, or under a condition that is not in the model (`Condition.reference`)."""
    source = EpisodeSource(system, setup, condition)
    std = vector(source.setup.noise_std, source.system.ny, "noise_std")
    if not source.condition.reference or source.fixed_x0 or not (std > 0).all():
        return None
    draws = source.draw([Stream(np.random.SeedSequence(seed)) for seed in seeds])
    episodes = source.play(draws)
    record, x = source.record(episodes), episodes.x[: source.setup.num_steps].swapaxes(0, 1)
    Q = None if source.process_noise is None else np.diag(source.process_noise**2)
    P0, R = record.prior.cov[0], np.diag(std**2)
    P = cramer_rao(source.system, record.t, x, P0, R, Q, np.isnan(record.y))
    counted = (source.system.scale, source.system.observable(x))
    expected = expected_scores(P, *counted)
    if Q is None:
        error = step_error(source.system, record.t, x)
        floor = expected_scores(error[..., None] * error[..., None, :], *counted)
        expected = {n: np.where(v > floor[n], v, np.nan) for n, v in expected.items()}
    std = np.sqrt(np.einsum("bkii->bki", P))
    return expected | {"by_sample": by_sample(std, *counted)}


def _number_of(values: np.ndarray | None, row: int) -> float | None:
    """That row's value, if it has one."""
    return None if values is None or np.isnan(values[row]) else values[row].item()


def _checked(estimates: Estimates, estimator: Estimator, shape: tuple[int, ...]) -> np.ndarray:
    xhat = np.asarray(estimates.xhat, dtype=float)
    if xhat.shape != shape:
        raise ValueError(
            f"{type(estimator).__name__} returned estimates of shape {xhat.shape}; expected {shape}"
        )
    return xhat


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


def canonical(value: Any) -> Any:
    """The value in JSON's types, the same for equal values; large things by a hash."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        return canonical(value.tolist())
    if isinstance(value, Mapping):
        return {str(name): canonical(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [canonical(part) for part in value]
    if isinstance(value, System):
        return {"system": type(value).__name__, **canonical(value.parameters)}
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: canonical(getattr(value, f.name)) for f in fields(value) if f.repr}
    if isinstance(value, np.generic):
        return value.item()
    return getattr(value, "__qualname__", type(value).__qualname__)


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Versions of what a score depends on."""
    packages = ("pinnobs-gym", "numpy", "scipy", "torch", "gymnasium")
    found = {name: importlib.metadata.version(name) for name in packages}
    return {"python": platform.python_version(), **found}


def now() -> str:
    """The date and time (UTC), as rows have them."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


LOGGED = ("nrmse", "nrmse_75", "nrmse_tail", "rmse", "settling", "peak")
"""The scores that TensorBoard shows."""


def log_episodes(
    log: Log, rows: list[Row], estimator: Estimator, example: dict[str, Any] | None
) -> None:
    """Log the scores of each episode over its seed, and a picture of one of them."""
    for row in rows:
        for name in LOGGED:
            if np.isfinite(row[name]):
                log.scalar(f"episode/{name}", row[name], row["episode_seed"])
    first = rows[0]
    if example is not None and log.active:
        title = f"{first['env_id']}, {first['condition']}: {first['estimator']}"
        drawn = {name: value for name, value in example.items() if name != "seed"}
        log.figure("states", state_figure(estimator.system, title=title, **drawn), example["seed"])


def log_summary(log: Log, rows: list[Row]) -> None:
    """Log an estimator's settings and what came of them for the HPARAMS table: medians, in which
    diverged episodes count as infinite, where they are finite."""
    first = rows[0]
    parameters = {n: first[n] for n in ("env_id", "setup", "condition", "estimator", "track")}
    parameters |= first["options"]
    diverged = np.array([row["diverged"] for row in rows])
    scores = {name: np.where(diverged, np.inf, [row[name] for row in rows]) for name in LOGGED}
    medians = {f"median/{name}": float(np.median(values)) for name, values in scores.items()}
    summary = {name: value for name, value in medians.items() if np.isfinite(value)}
    summary["diverged"] = float(diverged.mean())
    log.hparams(parameters, summary)
