"""The tables of a system under a condition, as cells and as Markdown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.standings import Standing, standing
from pinnobs_gym.scoring.rows import Row


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
