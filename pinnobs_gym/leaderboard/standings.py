"""Summaries of stored scores, computed without running an estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.leaderboard.intervals import Interval, median, rate
from pinnobs_gym.scoring.consistency import band
from pinnobs_gym.scoring.metrics import DIVERGED
from pinnobs_gym.scoring.rows import Row


@dataclass(frozen=True)
class Standing:
    """The summary of one estimator's episodes of one game."""

    estimator: str
    track: str
    episodes: int
    diverged: Interval
    """Rate of diverged episodes, with Wilson's interval."""
    settling: Interval
    """Median settling time in s."""
    nrmse: Interval
    """Median NRMSE over the whole episode."""
    tail: Interval
    """Median NRMSE over the last quarter."""
    tail_modulo: float | None
    """Median NRMSE over the last quarter modulo indistinguishable states; None if it is the
    same."""
    tail_90: float
    """90th percentile of the NRMSE over the last quarter."""
    reference_ratio: float | None
    """Median of the NRMSE over the Cramér-Rao reference of the same episode; None without a
    reference."""
    reference_ratio_tail: float | None
    """The same over the last quarter."""
    anees: Interval | None
    """Mean over episodes, with the band expected of consistent estimates; None without
    covariances."""
    coverage: float | None
    """Mean over episodes."""
    nis: float | None
    """Mean over episodes."""
    innovation_correlation: float | None
    """Mean over episodes."""
    us_per_step: float
    knows: str
    budget: float | None
    """CPU seconds allotted to training; None without such a limit."""
    training: str
    """Short description of the training."""
    seed: int | None
    """Training seed; None without training, or of several seeds together."""


def standing(rows: Sequence[Row]) -> Standing:
    """Summarise one estimator's rows; diverged episodes have infinite scores."""
    diverged = np.array([row["diverged"] for row in rows])

    def values(name: str) -> np.ndarray:
        return np.where(diverged, np.inf, [row[name] for row in rows])

    first = rows[0]
    return Standing(
        estimator=first["estimator"],
        track=first["track"],
        episodes=len(rows),
        diverged=rate(int(diverged.sum()), len(rows)),
        settling=median(values("settling")),
        nrmse=median(values("nrmse")),
        tail=median(values("nrmse_tail")),
        tail_modulo=_modulo(rows),
        tail_90=float(np.quantile(values("nrmse_tail"), 0.9, method="higher")),
        reference_ratio=_statistic(np.median, rows, "reference_ratio"),
        reference_ratio_tail=_statistic(np.median, rows, "reference_ratio_tail"),
        anees=_anees(rows),
        coverage=_statistic(np.mean, rows, "coverage"),
        nis=_statistic(np.mean, rows, "nis"),
        innovation_correlation=_statistic(np.mean, rows, "innovation_correlation"),
        us_per_step=float(np.median([row["us_per_step"] for row in rows])),
        knows=", ".join(first["knows"]),
        budget=first["training"].get("config", {}).get("budget"),
        training=training_of(rows),
        seed=first["training_seed"] if len({row["training_seed"] for row in rows}) == 1 else None,
    )


def _modulo(rows: Sequence[Row]) -> float | None:
    tail = np.array([row["nrmse_tail"] for row in rows])
    modulo = np.array([row["nrmse_tail_modulo"] for row in rows])
    if not (modulo < tail).any():
        return None
    return float(np.median(np.where(modulo <= DIVERGED, modulo, np.inf)))


def _statistic(statistic: Callable[..., Any], rows: Sequence[Row], name: str) -> float | None:
    """Return a statistic of an optional score over the episodes that have it."""
    values = [row[name] for row in rows if row[name] is not None]
    return float(statistic(values)) if values else None


def _anees(rows: Sequence[Row]) -> Interval | None:
    mean = _statistic(np.mean, rows, "anees")
    return None if mean is None else Interval(mean, *band(len(rows), rows[0]["nx"]))


def training_of(rows: Sequence[Row]) -> str:
    """Return a short description of the training: budget or iterations, and CPU seconds."""
    facts = [row["training"] for row in rows if row["training"]]
    if not facts:
        return ""
    budget = facts[0].get("config", {}).get("budget")
    parts = [] if budget is None else [f"budget {budget:g} s"]
    for name, unit in (("iterations", "iterations"), ("seconds", "CPU s")):
        known = [fact[name] for fact in facts if fact.get(name) is not None]
        if known:
            parts.append(f"{np.median(known):.4g} {unit}")
    if facts[0].get("per_record"):
        parts.append("on each record")
    return ", ".join(parts)
