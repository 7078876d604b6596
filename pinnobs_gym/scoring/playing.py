"""Playing a batch of episodes and scoring it."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from pinnobs_gym.envs.registration import make_vector_env
from pinnobs_gym.estimation.estimator import Estimates, Estimator
from pinnobs_gym.scoring.consistency import consistency
from pinnobs_gym.scoring.cramer_rao import _reference
from pinnobs_gym.scoring.curves import Curves, Example, curves_of
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, by_sample, score
from pinnobs_gym.scoring.provenance import now
from pinnobs_gym.scoring.rows import Row


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
