"""Scores of an episode: errors of the estimates relative to the truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.scoring.consistency import consistency
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import System

DIVERGED = 0.2
"""NRMSE over the last quarter above which an episode counts as diverged."""
SETTLED = 0.05
"""NRMSE of a sample up to which the estimate counts as settled."""


@dataclass(frozen=True)
class Scores:
    """The scores of a batch of episodes, as arrays (batch,). Scores that do not apply are None or,
    for single episodes, NaN. `error_scores`, `state_errors` and `consistency` define them."""

    mae: np.ndarray
    mse: np.ndarray
    rmse: np.ndarray
    smape: np.ndarray
    nrmse: np.ndarray
    nrmse_first: np.ndarray
    nrmse_transient: np.ndarray
    nrmse_steady: np.ndarray
    nrmse_75: np.ndarray
    nrmse_tail: np.ndarray
    settling: np.ndarray
    peak: np.ndarray
    nrmse_modulo: np.ndarray
    nrmse_steady_modulo: np.ndarray
    nrmse_tail_modulo: np.ndarray
    diverged: np.ndarray
    state_rmse: Mapping[str, Mapping[str, np.ndarray]]
    """RMSE of each state by window and name; see `state_errors`."""
    anees: np.ndarray | None = None
    coverage: np.ndarray | None = None
    nis: np.ndarray | None = None
    innovation_correlation: np.ndarray | None = None
    reference_steady: np.ndarray | None = None
    """NRMSE of the steady window that is expected of errors as large as the Cramér-Rao reference of
    the same episode (`pinnobs_gym.scoring.cramer_rao`)."""

    def rows(self) -> list[dict[str, Any]]:
        """Return the scores of each episode by name."""
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "state_rmse"}
        return [
            {name: _number(name, column, i) for name, column in columns.items()}
            | {"state_rmse": self._states(i)}
            for i in range(len(self.nrmse))
        ]

    def _states(self, i: int) -> dict[str, dict[str, float]]:
        """Return the errors of each state in one episode, without states that do not count."""
        return {
            window: {name: v[i].item() for name, v in states.items() if not np.isnan(v[i])}
            for window, states in self.state_rmse.items()
        }


def _number(name: str, column: np.ndarray | None, i: int) -> float | bool | None:
    """Return the value of one episode, or None if it has none."""
    if column is None or (name in OPTIONAL_SCORES and np.isnan(column[i])):
        return None
    return column[i].item()


SCORES = tuple(
    f.name
    for f in fields(Scores)
    if f.default is MISSING and f.name not in ("diverged", "state_rmse")
)
"""The scores that every episode has as a number, besides ``diverged`` and ``state_rmse``."""
OPTIONAL_SCORES = tuple(f.name for f in fields(Scores) if f.default is None)
"""The scores that apply to some episodes: those of `pinnobs_gym.scoring.consistency`, and the
Cramér-Rao reference (`pinnobs_gym.scoring.cramer_rao`)."""
STATE_WINDOWS = ("transient", "steady")
"""The windows over which errors are given state by state."""


def score(
    system: System, record: Record, truth: np.ndarray, estimates: Estimates, transient_end: float
) -> Scores:
    """Score the estimates of a batch of episodes.

    Args:
        system: the model, which defines the scales of errors and the observable components.
        record: the record given to the estimator.
        truth: true states at its samples, shape (batch, num_samples, nx), in state units.
        estimates: x̂(k|k) at its samples, and any covariances and innovations.
        transient_end: `Setup.transient_end`, in s from the first sample.

    Returns:
        All scores except the Cramér-Rao reference.

    Raises:
        ValueError: if truth and estimates have different shapes.
    """
    xhat, scored = np.asarray(estimates.xhat, dtype=float), system.observable(truth)
    alternatives = system.indistinguishable(truth)
    if (period := system.state_period) is not None:  # of an angle, the representative nearest to x
        xhat = nearest(xhat, truth, period)
        estimates = replace(estimates, xhat=xhat)
        alternatives = [nearest(np.asarray(other), xhat, period) for other in alternatives]
    errors: dict[str, Any] = error_scores(
        record.t,
        truth,
        xhat,
        system.scale,
        transient_end=transient_end,
        scored=scored,
        alternatives=alternatives,
    )
    own: dict[str, Any] = consistency(truth, estimates, np.isnan(record.y))
    by_window = state_errors(windows(record.t, transient_end), truth, xhat, scored)
    states = {
        window: dict(zip(system.state_names, values.T, strict=True))
        for window, values in by_window.items()
    }
    return Scores(**errors, **own, state_rmse=states)


def windows(t: np.ndarray, transient_end: float, start: float | None = None) -> dict[str, slice]:
    """Return the samples of each window of an episode.

    Args:
        t: sample times in s, shape (num_samples,).
        transient_end: end of the transient window, in s from the start.
        start: time in s at which the episode starts; that of the first sample if None.

    Returns:
        Slices by name: ``first`` is the first sample, whose estimate has seen one output only;
        ``transient`` the samples after it up to the end of the transient window, ``steady`` all
        later ones; ``whole`` all samples, ``75`` the last 75 % and ``tail`` the last 25 %. Each
        window has at least one sample; those of an episode of one or two samples overlap.
    """
    n = len(t)
    since = t - (t[0] if start is None else start)
    within = int(np.searchsorted(since, transient_end * (1 + 1e-9), side="right"))
    steady = min(max(within, 2), n - 1)
    return {
        "whole": slice(0, n),
        "first": slice(0, 1),
        "transient": slice(min(1, n - 1), max(steady, 2)),
        "steady": slice(steady, n),
        "75": slice(round(0.25 * n), n),
        "tail": slice(min(round(0.75 * n), n - 1), n),
    }


def state_errors(
    parts: Mapping[str, slice], x: np.ndarray, xhat: np.ndarray, scored: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return the root mean square error of each state over each of the `STATE_WINDOWS`, arrays
    (batch, nx) in state units: NaN for a state that does not count at any sample, infinite where
    the estimates are not finite.

    Args:
        parts: the `windows`.
        x: true states, shape (batch, num_samples, nx).
        xhat: estimates, same shape.
        scored: which errors count, bool, same shape; all if None.
    """
    counts = np.ones(x.shape, dtype=bool) if scored is None else scored
    errors = {}
    for name in STATE_WINDOWS:
        part, count = parts[name], counts[:, parts[name]].sum(axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            square = np.where(counts[:, part], (xhat - x)[:, part] ** 2, 0.0).sum(axis=1)
            mean = np.divide(square, count, out=np.full(square.shape, np.nan), where=count > 0)
        errors[name] = np.sqrt(np.where((count > 0) & ~np.isfinite(mean), np.inf, mean))
    return errors


def error_scores(
    t: np.ndarray,
    x: np.ndarray,
    xhat: np.ndarray,
    scale: Sequence[float],
    *,
    transient_end: float,
    scored: np.ndarray | None = None,
    alternatives: Sequence[np.ndarray] = (),
    known: np.ndarray | bool = True,
    start: float | None = None,
) -> dict[str, np.ndarray]:
    """Compute the scores that depend on errors alone, for a batch of episodes.

    Args:
        t: sample times in s, shape (num_samples,).
        x: true states, shape (batch, num_samples, nx).
        xhat: estimates, same shape; an episode with a value that is not finite counts as diverged.
        scale: scale of the errors, one number per state.
        transient_end: end of the transient window, in s from the start.
        scored: which errors count in NRMSE, bool, shape of x; all if None.
        alternatives: states indistinguishable from x by any output, arrays of x's shape.
        known: which of the true states are known, bool, shape of x, some of each episode; the
            others count in no score, which ``scored`` says, too.
        start: time in s at which the episode starts; that of the first sample if None.

    Returns:
        Arrays (batch,) by name; infinite where the estimates are not finite:

        - ``mae``, ``mse``, ``rmse`` in state units and ``smape`` in %: over all states and samples,
          transient included (Farkane et al., PINN-Obs, "Neural Network Training and Testing").
        - ``nrmse``, ``nrmse_first``, ``nrmse_transient``, ``nrmse_steady``, ``nrmse_75``,
          ``nrmse_tail``: root mean square of (x̂ − x)/scale over the whole episode, its first
          sample, the transient and the steady window, the last 75 % and the last 25 %; see
          `windows`.
        - ``settling``: the time in s after which the NRMSE of every sample is at most 5 %;
          infinite if that of the last sample is more.
        - ``peak``: the largest NRMSE of a sample.
        - ``nrmse_modulo``, ``nrmse_steady_modulo``, ``nrmse_tail_modulo``: as above, with each
          sample's error relative to the nearest of x and its alternatives.
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
            "mae": abs(error).mean(axis=(1, 2), where=known),
            "mse": square.mean(axis=(1, 2), where=known),
            "rmse": np.sqrt(square.mean(axis=(1, 2), where=known)),
            "smape": 100 * relative.mean(axis=(1, 2), where=known),
        }
        counts = np.ones(x.shape, dtype=bool) if scored is None else scored
        total, number = _sums(error, scale, counts)
        parts = windows(t, transient_end, start)
        for name, part in parts.items():
            scores[_score_name(name)] = window_nrmse(total, number, part)
        by_sample = np.sqrt(total / np.maximum(number, 1))
        scores["settling"] = _settling(t, by_sample, t[0] if start is None else start)
        scores["peak"] = by_sample.max(axis=1)
        for other in alternatives:
            total = np.minimum(total, _sums(xhat - other, scale, counts)[0])
        for name in ("whole", "steady", "tail"):
            scores[f"{_score_name(name)}_modulo"] = window_nrmse(total, number, parts[name])
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


def window_nrmse(total: np.ndarray, number: np.ndarray, part: slice) -> np.ndarray:
    """Return the NRMSE over a window, shape (batch,), given each sample's sum of squared scaled
    errors and their number, shape (batch, num_samples)."""
    return np.sqrt(total[:, part].sum(axis=1) / np.maximum(number[:, part].sum(axis=1), 1))


def _score_name(window: str) -> str:
    """Return the name of the NRMSE of a window."""
    return "nrmse" if window == "whole" else f"nrmse_{window}"


def _settling(t: np.ndarray, by_sample: np.ndarray, start: float) -> np.ndarray:
    above = ~(by_sample <= SETTLED)
    last = len(t) - 1 - np.argmax(above[:, ::-1], axis=1)
    after = np.append(t, np.inf)[last + 1] - start
    return np.where(above.any(axis=1), after, 0.0)
