"""Tables of stored scores. Nothing here runs an estimator."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pinnobs_gym.consistency import band
from pinnobs_gym.intervals import Interval, median, rate
from pinnobs_gym.metrics import DIVERGED
from pinnobs_gym.rows import Row


@dataclass(frozen=True)
class Standing:
    """How one estimator did on the episodes of one env, setup and condition."""

    estimator: str
    track: str
    episodes: int
    diverged: Interval
    """Rate, with Wilson's interval."""
    settling: Interval
    """Median in s."""
    nrmse: Interval
    """Median over the whole episode."""
    tail: Interval
    """Median over the last quarter."""
    tail_modulo: float | None
    """Median of the same modulo indistinguishable states; None where that changes nothing."""
    tail_90: float
    """90th percentile over the last quarter."""
    reference_ratio: float | None
    """Median NRMSE over the Cramér-Rao reference of the same episode; None where there is none."""
    reference_ratio_tail: float | None
    """The same of the last quarter."""
    anees: Interval | None
    """Mean over episodes, with the band that it should be in; None without covariances."""
    coverage: float | None
    """Mean over episodes."""
    nis: float | None
    """Mean over episodes."""
    innovation_correlation: float | None
    """Mean over episodes."""
    us_per_step: float
    knows: str
    budget: float | None
    """CPU seconds that training was given, if it was limited so."""
    training: str
    """How it was trained, in a few words."""


@dataclass(frozen=True)
class Table:
    """The standings on one env, setup and condition, best first, online before offline."""

    env_id: str
    setup: str
    condition: str
    standings: tuple[Standing, ...]
    note: str = ""
    """What to know about it, if anything."""

    @property
    def title(self) -> str:
        """What is played."""
        return f"{self.env_id}, {self.setup}, {self.condition}"


def tables(rows: Iterable[Row], failures: Iterable[Row] = ()) -> list[Table]:
    """A table per env, setup and condition. Within a track estimators stand in the order of their
    median NRMSE over the whole episode, diverged episodes counting as infinite. What failed is told
    in the notes."""
    played: dict[tuple[str, str, str], dict[tuple[str, str], list[Row]]]
    played = defaultdict(lambda: defaultdict(list))
    for row in rows:
        game = (row["env_id"], row["setup"], row["condition"])
        played[game][row["estimator"], row["config_hash"]].append(row)
    failed: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for row in failures:
        game = (row["env_id"], row["setup"], row["condition"])
        many = row["episodes"] > 1
        which = f"{row['episodes']} episodes" if many else f"episode {row['episode_seed']}"
        failed[game].append(f"Failed: {row['estimator']}, {which}: {row['error'].rstrip('.')}.")
    result = []
    for game in sorted(played.keys() | failed.keys()):
        groups = played[game]
        standings = [standing(group) for group in groups.values()]
        standings.sort(key=lambda s: (s.track != "online", s.nrmse.value, s.tail.value))
        note = " ".join(filter(None, [_note(list(groups.values())), *failed[game]]))
        result.append(Table(*game, tuple(standings), note))
    return result


def _note(groups: Sequence[Sequence[Row]]) -> str:
    """A warning if estimators of one track were not run on the same episodes."""
    for track in {group[0]["track"] for group in groups}:
        played = {
            frozenset(row["episode_seed"] for row in group)
            for group in groups
            if group[0]["track"] == track
        }
        if len(played) > 1:
            return f"Not all {track} estimators were run on the same episodes: ranks are uncertain."
    return ""


def standing(rows: Sequence[Row]) -> Standing:
    """The summary of one estimator's rows; episodes that diverged score infinity."""
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
        reference_ratio=_of(np.median, rows, "reference_ratio"),
        reference_ratio_tail=_of(np.median, rows, "reference_ratio_tail"),
        anees=_anees(rows),
        coverage=_of(np.mean, rows, "coverage"),
        nis=_of(np.mean, rows, "nis"),
        innovation_correlation=_of(np.mean, rows, "innovation_correlation"),
        us_per_step=float(np.median([row["us_per_step"] for row in rows])),
        knows=", ".join(first["knows"]),
        budget=first["training"].get("config", {}).get("budget"),
        training=training_of(rows),
    )


def _modulo(rows: Sequence[Row]) -> float | None:
    tail = np.array([row["nrmse_tail"] for row in rows])
    modulo = np.array([row["nrmse_tail_modulo"] for row in rows])
    if not (modulo < tail).any():
        return None
    return float(np.median(np.where(modulo <= DIVERGED, modulo, np.inf)))


def _of(statistic: Callable[..., Any], rows: Sequence[Row], name: str) -> float | None:
    """A statistic of an optional score, over the episodes that have it."""
    values = [row[name] for row in rows if row[name] is not None]
    return float(statistic(values)) if values else None


def _anees(rows: Sequence[Row]) -> Interval | None:
    mean = _of(np.mean, rows, "anees")
    return None if mean is None else Interval(mean, *band(len(rows), rows[0]["nx"]))


def training_of(rows: Sequence[Row]) -> str:
    """How the estimator was trained, in a few words: budget or iterations, and CPU seconds."""
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


HEADER = (
    "",
    "estimator",
    "track",
    "episodes",
    "diverged %",
    "settled s",
    "NRMSE",
    "tail NRMSE",
    "90th pct.",
    "/ CRR",
    "tail / CRR",
    "ANEES",
    "covers %",
    "NIS",
    "corr.",
    "µs/step",
    "is told",
    "training",
)
"""The columns of a table."""


def cells(table: Table, intervals: bool = True) -> list[list[str]]:
    """The table's rows as text, a cell per column of `HEADER`, with or without the intervals."""
    shown = _interval if intervals else lambda interval: number(interval.value)
    lines, ranks = [], defaultdict(int)
    for s in table.standings:
        ranks[s.track] += 1
        tail = shown(s.tail)
        if s.tail_modulo is not None and number(s.tail_modulo) != number(s.tail.value):
            tail += f" [{number(s.tail_modulo)}]"
        lines.append(
            [
                str(ranks[s.track]),
                s.estimator if s.budget is None else f"{s.estimator}, {s.budget:g} s",
                s.track,
                str(s.episodes),
                shown(s.diverged.percent),
                number(s.settling.value),
                shown(s.nrmse),
                tail,
                number(s.tail_90),
                _optional(s.reference_ratio),
                _optional(s.reference_ratio_tail),
                _banded(s.anees),
                _optional(None if s.coverage is None else 100 * s.coverage, 2),
                _optional(s.nis),
                _optional(s.innovation_correlation, 2),
                number(s.us_per_step),
                s.knows,
                s.training,
            ]
        )
    return lines


def markdown(tables: Iterable[Table]) -> str:
    """The tables in Markdown."""
    parts = ["# Each game\n", NOTE + "\n"]
    for table in tables:
        parts.append(f"\n## {table.title}\n")
        parts.append(markdown_table(HEADER, cells(table)))
        parts += [f"\n{table.note}"] if table.note else []
    return "\n".join(parts) + "\n"


def markdown_table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """One table in Markdown."""
    rules = ["---"] * len(header)
    return "\n".join("| " + " | ".join(line) + " |" for line in (header, rules, *lines))


NOTE = (
    "Medians over episodes with 95 % intervals; NRMSE is the root mean squared error over the "
    "system's fixed scale, transient included, and tail NRMSE that over the last 25 %; an episode "
    "diverged if its tail NRMSE is above 0.2 or anything is not finite, and then scores infinity. "
    "Online estimators are causal; offline ones see the whole record first and are ranked apart. "
    "In brackets: modulo states that no output tells apart. Seconds behind a name are the CPU time "
    "that each training was given. / CRR: median NRMSE over the Cramér-Rao reference of the same "
    "episode, empty where there is none (the condition is not in the model, there is no noise, or "
    "the reference is below the error of a single step of the model). "
    "For those that give covariances, means over episodes: ANEES, which should be 1 (▲ above its "
    "95 % band: errors are larger than P says, ▼ below); how many errors the central 90 % interval "
    "covers; NIS, which should be 1; and the correlation of successive innovations, 0 if white."
)
"""How to read the tables."""


def number(value: float, digits: int = 3) -> str:
    """A score in so many significant digits."""
    if not np.isfinite(value):
        return "∞"
    if abs(value) >= 10**digits:
        return f"{value:.0f}" if abs(value) < 1e5 else f"{value:.1e}"
    return f"{value:.{digits}g}"


def _optional(value: float | None, digits: int = 3) -> str:
    return "" if value is None else number(value, digits)


def _banded(value: Interval | None) -> str:
    """The value, and on which side of its band it is."""
    if value is None:
        return ""
    side = " ▲" if value.value > value.high else " ▼" if value.value < value.low else ""
    return number(value.value) + side


def _interval(interval: Interval) -> str:
    if interval.low == interval.high:
        return number(interval.value)
    return f"{number(interval.value)} ({number(interval.low, 2)}-{number(interval.high, 2)})"
