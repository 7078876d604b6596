"""Summaries of stored scores, computed without running an estimator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.leaderboard.floor import NO_FLOOR, Floor, over_floor
from pinnobs_gym.leaderboard.intervals import Interval, median, rate
from pinnobs_gym.scoring.consistency import band
from pinnobs_gym.scoring.identifiability import Identifiability
from pinnobs_gym.scoring.metrics import DIVERGED
from pinnobs_gym.scoring.rows import Row


@dataclass(frozen=True)
class Standing:
    """The summary of one estimator's episodes of one game."""

    estimator: str
    track: str
    episodes: int
    """Number of different episodes."""
    trainings: int
    """Number of training seeds; 1 without training."""
    scored: int
    """Number of scored episodes of all training seeds."""
    diverged: Interval
    """Rate of diverged episodes, with Wilson's interval."""
    settling: Interval
    """Median settling time in s."""
    transient: Interval
    """Median NRMSE over the transient window (`pinnobs_gym.scoring.metrics.windows`)."""
    steady: Interval
    """Median NRMSE over the steady window."""
    steady_modulo: float | None
    """Median NRMSE over the steady window modulo indistinguishable states; None if it is the
    same."""
    steady_90: float
    """90th percentile of the NRMSE over the steady window."""
    first: float
    """Median NRMSE of the first sample."""
    whole: float
    """Median NRMSE over the whole episode."""
    late: float
    """Median NRMSE over the last 75 %."""
    tail: float
    """Median NRMSE over the last 25 %."""
    over_reference: float | None
    """Root mean square over episodes of the NRMSE of the steady window, over that of the
    Cramér-Rao reference of the same episodes; None without a reference."""
    over_floor_steady: Interval | None
    """Root mean square over episodes of the NRMSE of the steady window, over that of the floor on
    the same episodes (`pinnobs_gym.leaderboard.floor`); None without a floor."""
    over_floor_transient: Interval | None
    """The same of the transient window."""
    identifiable: bool
    """Whether the states can be told from the outputs under the game's condition
    (`pinnobs_gym.scoring.identifiability`)."""
    anees: Interval | None
    """Mean over episodes, with the band expected of consistent estimates; None without
    covariances."""
    coverage: float | None
    """Mean over episodes."""
    nis: float | None
    """Mean over episodes."""
    innovation_correlation: float | None
    """Mean over episodes."""
    us_per_step: float | None
    """Median over episodes; None where it is not known, as of submitted estimates."""
    knows: tuple[str, ...]
    budget: float | None
    """CPU seconds allotted to training; None without such a limit."""
    training: str
    """Short description of the training."""


def standing(rows: Sequence[Row], floor: Floor = NO_FLOOR) -> Standing:
    """Summarise one estimator's rows; diverged episodes have infinite scores, but for the ratios to
    the Cramér-Rao reference and to the floor of the game."""
    diverged = np.array([row["diverged"] for row in rows])

    def values(name: str) -> np.ndarray:
        return np.where(diverged, np.inf, [row[name] for row in rows])

    first, referred = rows[0], [row for row in rows if row["reference_steady"] is not None]
    return Standing(
        estimator=first["estimator"],
        track=first["track"],
        episodes=len({row["episode"] for row in rows}),
        trainings=len({row["training_seed"] for row in rows}),
        scored=len({(row["training_seed"], row["episode"]) for row in rows}),
        diverged=rate(int(diverged.sum()), len(rows)),
        settling=median(values("settling")),
        transient=median(values("nrmse_transient")),
        steady=median(values("nrmse_steady")),
        steady_modulo=_modulo(rows),
        steady_90=float(np.quantile(values("nrmse_steady"), 0.9, method="higher")),
        first=float(np.median(values("nrmse_first"))),
        whole=float(np.median(values("nrmse"))),
        late=float(np.median(values("nrmse_75"))),
        tail=float(np.median(values("nrmse_tail"))),
        over_reference=over_reference(referred) if referred else None,
        over_floor_steady=over_floor({"": (rows, floor)}, "steady"),
        over_floor_transient=over_floor({"": (rows, floor)}, "transient"),
        identifiable=is_identifiable(first),
        anees=_anees(rows),
        coverage=_statistic(np.mean, rows, "coverage"),
        nis=_statistic(np.mean, rows, "nis"),
        innovation_correlation=_statistic(np.mean, rows, "innovation_correlation"),
        us_per_step=_statistic(np.median, rows, "us_per_step"),
        knows=tuple(first["knows"]),
        budget=first["training"].get("config", {}).get("budget"),
        training=training_of(rows),
    )


def is_identifiable(row: Row) -> bool:
    """Return whether the states can be told from the outputs in a row's game."""
    found = row["free_over_known"], row["nominal_over_free"]
    return None in found or Identifiability(*found).holds


def _modulo(rows: Sequence[Row]) -> float | None:
    steady = np.array([row["nrmse_steady"] for row in rows])
    modulo = np.array([row["nrmse_steady_modulo"] for row in rows])
    if not (modulo < steady).any():
        return None
    lost = np.array([not row["nrmse_tail_modulo"] <= DIVERGED for row in rows])
    return float(np.median(np.where(lost, np.inf, modulo)))


def over_reference(rows: Sequence[Row]) -> float:
    """Return the root mean square over episodes of the NRMSE of the steady window, over that of
    their Cramér-Rao reference, which all of them have."""
    error, bound = (
        np.sum(np.square([row[name] for row in rows]))
        for name in ("nrmse_steady_modulo", "reference_steady")
    )
    return float(np.sqrt(error / bound))


def _statistic(statistic: Callable[..., Any], rows: Sequence[Row], name: str) -> float | None:
    """Return a statistic of an optional score over the episodes that have it."""
    values = [row[name] for row in rows if row[name] is not None]
    return float(statistic(values)) if values else None


def _anees(rows: Sequence[Row]) -> Interval | None:
    mean = _statistic(np.mean, rows, "anees")
    episodes = len({row["episode"] for row in rows})
    return None if mean is None else Interval(mean, *band(episodes, rows[0]["nx"]))


def training_of(rows: Sequence[Row]) -> str:
    """Return a short description of the training: budget or iterations, and CPU seconds."""
    facts = [row["training"] for row in rows if row["training"]]
    if not facts:
        return ""
    budget = facts[0].get("config", {}).get("budget")
    parts = [] if budget is None else [f"budget {budget:g} s"]
    for name, unit, plural in (("iterations", "iteration", "s"), ("seconds", "CPU s", "")):
        known = [fact[name] for fact in facts if fact.get(name) is not None]
        if known:
            middle = float(np.median(known))
            parts.append(f"{middle:.4g} {unit}{'' if middle == 1 else plural}")
    if facts[0].get("per_record"):
        parts.append("on each record")
    return ", ".join(parts)
