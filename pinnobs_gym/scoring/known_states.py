"""Scores of an episode whose true states are known in part: at some samples, and some states."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from pinnobs_gym.estimation.estimator import Estimates
from pinnobs_gym.scoring.consistency import consistency
from pinnobs_gym.scoring.metrics import Scores, error_scores, state_errors, windows
from pinnobs_gym.simulation.record import Record
from pinnobs_gym.simulation.residual import nearest
from pinnobs_gym.simulation.system import System


def counted(system: System, truth: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return which errors are scored, bool (batch, num_samples, nx): those of states that are known
    and that the outputs determine (`System.observable`).

    Args:
        system: the model.
        truth: true states, shape (batch, num_samples, nx), NaN where unknown.
        mean: prior means (batch, nx), which stand for the unknown states.
    """
    return ~np.isnan(truth) & np.asarray(system.observable(_filled(truth, mean)))


def score_known(
    system: System,
    record: Record,
    truth: np.ndarray,
    estimates: Estimates,
    transient_end: float,
) -> Scores:
    """Score estimates where true states are known, as `pinnobs_gym.scoring.metrics.score` does
    where all of them are; if they are, the scores are the same.

    Errors and their covariances are scored at the samples with a known state, and windows consist
    of these samples. Times count from the first sample of the record. Innovations are scored at all
    samples that have outputs, each compared with the next of these.

    Args:
        system: the model, which defines the scales of errors and the observable components.
        record: the record given to the estimator.
        truth: true states at its samples, shape (batch, num_samples, nx), in state units; NaN
            where unknown, at the same samples and in the same states of all episodes.
        estimates: x̂ at its samples, and any covariances and innovations. An episode with an
            estimate that is not finite counts as diverged, also where nothing is known.
        transient_end: end of the transient window, in s from the first sample.

    Raises:
        ValueError: if the shapes differ, or no state is known.
    """
    xhat = np.asarray(estimates.xhat, dtype=float)
    if xhat.shape != truth.shape:
        raise ValueError(f"xhat has shape {xhat.shape}; expected {truth.shape}, that of the states")
    at = (~np.isnan(truth)).any(axis=(0, 2))
    if not at.any():
        raise ValueError("no true state is known at any sample; expected some")
    mean = record.prior.mean
    lost = ~np.isfinite(xhat).all(axis=(1, 2), keepdims=True)
    x = _filled(truth[:, at], mean)
    xhat = nearest(np.where(lost, np.nan, xhat[:, at]), x, system.state_period)
    alternatives = [np.asarray(other) for other in system.indistinguishable(x)]
    if (period := system.state_period) is not None:
        alternatives = [nearest(other, xhat, period) for other in alternatives]
    scored = counted(system, truth[:, at], mean)
    t, start = record.t[at], float(record.t[0])
    errors: dict[str, Any] = error_scores(
        t,
        x,
        xhat,
        system.scale,
        transient_end=transient_end,
        scored=scored,
        alternatives=alternatives,
        known=~np.isnan(truth[:, at]),
        start=start,
    )
    P = None if estimates.P is None else estimates.P[:, at]
    own: dict[str, Any] = _consistency(truth[:, at], replace(estimates, xhat=xhat, P=P))
    own |= _whiteness(record, estimates)
    by_window = state_errors(windows(t, transient_end, start), x, xhat, scored)
    states = {
        window: dict(zip(system.state_names, values.T, strict=True))
        for window, values in by_window.items()
    }
    return Scores(**errors, **own, state_rmse=states)


def _filled(truth: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Return the true states, with the prior means (batch, nx) in place of those unknown: what is
    observable may depend on all states, and must not depend on an estimator."""
    return np.where(np.isnan(truth), mean[:, None], truth)


def _consistency(truth: np.ndarray, estimates: Estimates) -> dict[str, np.ndarray | None]:
    """Return ``anees`` and ``coverage`` of `pinnobs_gym.scoring.consistency.consistency` over the
    known states of samples that have some: of the joint distribution of the errors, that of the
    known ones is the marginal."""
    if estimates.P is None:
        return {"anees": None, "coverage": None}
    known = ~np.isnan(truth).any(axis=0)
    total, inside, number = np.zeros(len(truth)), np.zeros(len(truth)), 0
    for pattern in np.unique(known, axis=0):
        rows = (known == pattern).all(axis=1)
        part = Estimates(
            estimates.xhat[:, rows][..., pattern],
            estimates.P[:, rows][..., pattern, :][..., pattern],
        )
        x = truth[:, rows][..., pattern]
        own: dict[str, Any] = consistency(x, part, np.zeros((*x.shape[:2], 0), dtype=bool))
        total += own["anees"] * x[0].size
        inside += own["coverage"] * x[0].size
        number += x[0].size
    return {"anees": total / number, "coverage": inside / number}


def _whiteness(record: Record, estimates: Estimates) -> dict[str, np.ndarray | None]:
    """Return ``nis`` and ``innovation_correlation`` of the samples that have outputs."""
    names = ("nis", "innovation_correlation")
    seen = ~np.isnan(record.y).all(axis=(0, 2))
    if estimates.innovation is None or estimates.S is None or not seen.any():
        return dict.fromkeys(names)
    part = Estimates(estimates.xhat, None, estimates.innovation[:, seen], estimates.S[:, seen])
    own = consistency(estimates.xhat, part, np.isnan(record.y[:, seen]))
    return {name: own[name] for name in names}
