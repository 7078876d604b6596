"""Scores of an episode: errors of the estimates relative to the truth."""

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
"""NRMSE over the last quarter above which an episode counts as diverged."""
SETTLED = 0.05
"""NRMSE of a sample up to which the estimate counts as settled."""


@dataclass(frozen=True)
class Scores:
    """The scores of a batch of episodes, as arrays (batch,). Scores that do not apply are None or,
    for single episodes, NaN. `error_scores` and `consistency` define them."""

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
    (`pinnobs_gym.scoring.cramer_rao`), with the error taken modulo indistinguishable states."""
    reference_ratio_tail: np.ndarray | None = None
    """The same over the last 25 % of the episode."""

    def rows(self) -> list[dict[str, float | bool | None]]:
        """Return the scores of each episode by name."""
        columns = {f.name: getattr(self, f.name) for f in fields(self)}
        return [
            {name: _number(name, column, i) for name, column in columns.items()}
            for i in range(len(self.nrmse))
        ]


def _number(name: str, column: np.ndarray | None, i: int) -> float | bool | None:
    """Return the value of one episode, or None if it has none."""
    if column is None or (name in OPTIONAL_SCORES and np.isnan(column[i])):
        return None
    return column[i].item()


SCORES = tuple(f.name for f in fields(Scores) if f.default is MISSING and f.name != "diverged")
"""The scores that every episode has, besides ``diverged``."""
OPTIONAL_SCORES = tuple(f.name for f in fields(Scores) if f.default is None)
"""The scores that apply to some episodes: those of `pinnobs_gym.scoring.consistency`, and the NRMSE
of the whole episode and of its tail over their Cramér-Rao reference
(`pinnobs_gym.scoring.cramer_rao`)."""


def score(system: System, record: Record, truth: np.ndarray, estimates: Estimates) -> Scores:
    """Score the estimates of a batch of episodes.

    Args:
        system: the model, which defines the scales of errors and the observable components.
        record: the record given to the estimator.
        truth: true states at its samples, shape (batch, num_samples, nx), in state units.
        estimates: x̂(k|k) at its samples, and any covariances and innovations.

    Returns:
        All scores except those relative to the Cramér-Rao reference.

    Raises:
        ValueError: if truth and estimates have different shapes.
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
    """Compute the scores that depend on errors alone, for a batch of episodes.

    Args:
        t: sample times in s, shape (num_samples,).
        x: true states, shape (batch, num_samples, nx).
        xhat: estimates, same shape; an episode with a value that is not finite counts as diverged.
        scale: scale of the errors, one number per state.
        scored: which errors count in NRMSE, bool, shape of x; all if None.
        alternatives: states indistinguishable from x by any output, arrays of x's shape.

    Returns:
        Arrays (batch,) by name; infinite where the estimates are not finite:

        - ``mae``, ``mse``, ``rmse`` in state units and ``smape`` in %: over all states and samples,
          transient included (Farkane et al., PINN-Obs, "Neural Network Training and Testing").
        - ``nrmse``, ``nrmse_75``, ``nrmse_tail``: root mean square of (x̂ − x)/scale over the whole
          episode, its last 75 % and its last 25 %.
        - ``settling``: the time in s after which the NRMSE of every sample stays below 5 %;
          infinite if that of the last sample is above.
        - ``peak``: the largest NRMSE of a sample.
        - ``nrmse_modulo``, ``nrmse_tail_modulo``: as above, with each sample's error relative to
          the nearest of x and its alternatives.
        - ``diverged``: bool, whether an estimate is not finite or ``nrmse_tail`` exceeds 0.2.
    """
    if x.shape != xhat.shape or x.ndim != 3 or len(t) != x.shape[1]:
        raise ValueError(f"xhat has shape {xhat.shape}; expected {x.shape}, that of the states")
    finite = np.isfinite(xhat).all(axis=(1, 2))
    with np.errstate(all="ignore"):  # rows that are not finite are overwritten below
        xhat = np.ascontiguousarray(xhat)  # the order of a sum depends on the order in memory
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
    """Return the NRMSE of each sample, shape (batch, num_samples), of errors (batch, num_samples,
    nx); NaN where no error counts.

    Args:
        error: x̂ − x, or its standard deviation.
        scale: scale of the errors, one number per state.
        scored: which errors count, bool, shape of error; all if None.
    """
    counts = np.ones(error.shape, dtype=bool) if scored is None else scored
    with np.errstate(over="ignore", invalid="ignore"):  # values too large become infinite
        total, number = _sums(error, scale, counts)
        mean = np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
    return np.sqrt(mean)


def _sums(
    error: np.ndarray, scale: Sequence[float], counts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each sample, the sum of the squared scaled errors that count, and their
    number."""
    square = np.where(counts, (error / np.asarray(scale)) ** 2, 0.0)
    return square.sum(axis=-1), counts.sum(axis=-1)


def window(total: np.ndarray, number: np.ndarray, part: float) -> np.ndarray:
    """Return the NRMSE over the last part of the samples."""
    first = round((1 - part) * total.shape[1])
    return np.sqrt(total[:, first:].sum(axis=1) / np.maximum(number[:, first:].sum(axis=1), 1))


def _settling(t: np.ndarray, by_sample: np.ndarray) -> np.ndarray:
    above = ~(by_sample <= SETTLED)
    last = len(t) - 1 - np.argmax(above[:, ::-1], axis=1)
    after = np.append(t, np.inf)[last + 1] - t[0]
    return np.where(above.any(axis=1), after, 0.0)
