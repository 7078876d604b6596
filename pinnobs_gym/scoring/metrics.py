"""Scores of an episode: how far the estimates were from the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.scoring.consistency import consistency
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.system import System

DIVERGED = 0.2
"""NRMSE over the last quarter from which on an episode counts as diverged."""
SETTLED = 0.05
"""NRMSE of a sample below which the estimate counts as settled."""


@dataclass(frozen=True)
class Scores:
    """The scores of a batch of episodes: arrays (batch,), of which those that do not apply are None
    or, in single episodes, not a number. `error_scores` and `consistency` say what they are."""

    mae: np.ndarray
    mse: np.ndarray
    rmse: np.ndarray
    smape: np.ndarray
    nrmse: np.ndarray
    nrmse_75: np.ndarray
    nrmse_tail: np.ndarray
    settling: np.ndarray
    peak: np.ndarray
    nrmse_modulo: np.ndarray
    nrmse_tail_modulo: np.ndarray
    diverged: np.ndarray
    anees: np.ndarray | None = None
    coverage: np.ndarray | None = None
    nis: np.ndarray | None = None
    innovation_correlation: np.ndarray | None = None
    reference_ratio: np.ndarray | None = None
    """NRMSE of the whole episode over that of its Cramér-Rao reference
    (`pinnobs_gym.scoring.cramer_rao`), the error taken modulo what no output tells apart."""
    reference_ratio_tail: np.ndarray | None = None
    """The same of the tail."""

    def rows(self) -> list[dict[str, float | bool | None]]:
        """The scores of each episode by name."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        return [
            {name: _number(name, column, i) for name, column in columns.items()}
            for i in range(len(self.nrmse))
        ]


def _number(name: str, column: np.ndarray | None, i: int) -> float | bool | None:
    """The value of one episode, None if it has none."""
    if column is None or (name in OPTIONAL_SCORES and np.isnan(column[i])):
        return None
    return column[i].item()


SCORES = tuple(f.name for f in fields(Scores) if f.default is MISSING and f.name != "diverged")
"""The numbers that each episode has, besides ``diverged``."""
OPTIONAL_SCORES = tuple(f.name for f in fields(Scores) if f.default is None)
"""Numbers that episodes have where they apply: those of `pinnobs_gym.scoring.consistency`, and the
NRMSE of the whole episode and of its tail over their Cramér-Rao reference
(`pinnobs_gym.scoring.cramer_rao`)."""


def score(system: System, record: Record, truth: np.ndarray, estimates: Estimates) -> Scores:
    """The scores of estimates of a batch of episodes.

    Args:
        system: the model, which says what errors are divided by and what can be told from outputs.
        record: what the estimator saw.
        truth: true states at its samples, shape (batch, num_samples, nx), in state units.
        estimates: x̂(k|k) at its samples, and what else the estimator gave.

    Returns:
        All scores but those that hold against the Cramér-Rao reference.

    Raises:
        ValueError: if truth and estimates are not of one shape.
    """
    errors: dict[str, Any] = error_scores(
        record.t,
        truth,
        np.asarray(estimates.xhat, dtype=float),
        system.scale,
        scored=system.observable(truth),
        alternatives=system.indistinguishable(truth),
    )
    own: dict[str, Any] = consistency(truth, estimates, np.isnan(record.y))
    return Scores(**errors, **own)


def error_scores(
    t: np.ndarray,
    x: np.ndarray,
    xhat: np.ndarray,
    scale: Sequence[float],
    *,
    scored: np.ndarray | None = None,
    alternatives: Sequence[np.ndarray] = (),
) -> dict[str, np.ndarray]:
    """The scores of a batch of episodes that follow from errors alone.

    Args:
        t: sample times in s, shape (num_samples,).
        x: true states, shape (batch, num_samples, nx).
        xhat: estimates, same shape; anything not finite makes the episode a diverged one.
        scale: what errors are divided by, one number per state.
        scored: which errors count in NRMSE, bool, shape of x; all if None.
        alternatives: arrays of x's shape of states that no output tells from x.

    Returns:
        Arrays (batch,) by name; infinite where the estimates are not finite:

        - ``mae``, ``mse``, ``rmse`` in state units and ``smape`` in %: over all states and samples,
          transient included (Farkane et al., PINN-Obs, "Neural Network Training and Testing").
        - ``nrmse``, ``nrmse_75``, ``nrmse_tail``: root of the mean squared (x̂ − x)/scale over the
          whole episode, its last 75 % and its last 25 %.
        - ``settling``: the time in s after which the NRMSE of every sample stays below 5 %;
          infinite if the last one is above.
        - ``peak``: the largest NRMSE of a sample.
        - ``nrmse_modulo``, ``nrmse_tail_modulo``: as above, each sample's error taken to the
          nearest of x and its alternatives.
        - ``diverged``: bool, whether anything is not finite or ``nrmse_tail`` is over 0.2.
    """
    if x.shape != xhat.shape or x.ndim != 3 or len(t) != x.shape[1]:
        raise ValueError(f"xhat has shape {xhat.shape}; expected {x.shape}, that of the states")
    finite = np.isfinite(xhat).all(axis=(1, 2))
    with np.errstate(all="ignore"):  # rows that are not finite are overwritten below
        error = xhat - x
        square = error**2
        size = abs(x) + abs(xhat)
        relative = np.divide(2 * abs(error), size, out=np.zeros_like(size), where=size > 0)
        scores = {
            "mae": abs(error).mean(axis=(1, 2)),
            "mse": square.mean(axis=(1, 2)),
            "rmse": np.sqrt(square.mean(axis=(1, 2))),
            "smape": 100 * relative.mean(axis=(1, 2)),
        }
        counts = np.ones(x.shape, dtype=bool) if scored is None else scored
        total, number = _sums(error, scale, counts)
        scores["nrmse"] = window(total, number, 1.0)
        scores["nrmse_75"] = window(total, number, 0.75)
        scores["nrmse_tail"] = window(total, number, 0.25)
        by_sample = np.sqrt(total / np.maximum(number, 1))
        scores["settling"] = _settling(t, by_sample)
        scores["peak"] = by_sample.max(axis=1)
        for other in alternatives:
            total = np.minimum(total, _sums(xhat - other, scale, counts)[0])
        scores["nrmse_modulo"] = window(total, number, 1.0)
        scores["nrmse_tail_modulo"] = window(total, number, 0.25)
    for values in scores.values():
        values[~finite] = np.inf
    scores["diverged"] = ~(scores["nrmse_tail"] <= DIVERGED)
    return scores


def by_sample(
    error: np.ndarray, scale: Sequence[float], scored: np.ndarray | None = None
) -> np.ndarray:
    """The NRMSE of each sample, shape (batch, num_samples), of errors (batch, num_samples, nx);
    not a number where none of them counts.

    Args:
        error: x̂ − x, or the standard deviation of that.
        scale: what it is divided by, one number per state.
        scored: which of it counts, bool, shape of error; all if None.
    """
    counts = np.ones(error.shape, dtype=bool) if scored is None else scored
    with np.errstate(over="ignore", invalid="ignore"):  # what is too large is infinite
        total, number = _sums(error, scale, counts)
        mean = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
    return np.sqrt(mean)


def _sums(
    error: np.ndarray, scale: Sequence[float], counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """For each sample the sum of the squared scaled errors that count, and their number."""
    square = np.where(counts, (error / np.asarray(scale)) ** 2, 0.0)
    return square.sum(axis=-1), counts.sum(axis=-1)


def window(total: np.ndarray, number: np.ndarray, part: float) -> np.ndarray:
    """NRMSE over the last part of the samples."""
    first = round((1 - part) * total.shape[1])
    return np.sqrt(total[:, first:].sum(axis=1) / np.maximum(number[:, first:].sum(axis=1), 1))


def _settling(t: np.ndarray, by_sample: np.ndarray) -> np.ndarray:
    above = ~(by_sample <= SETTLED)
    last = len(t) - 1 - np.argmax(above[:, ::-1], axis=1)
    after = np.append(t, np.inf)[last + 1] - t[0]
    return np.where(above.any(axis=1), after, 0.0)
