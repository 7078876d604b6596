"""The tables across systems and conditions, as cells and as Markdown."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from pinnobs_gym.leaderboard.contenders import label
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.standings import Standing
from pinnobs_gym.leaderboard.standings_table import number, text_table

NOTE = (
    "Median NRMSE over the whole episode, under the condition that a system is ranked under; `div` "
    "is the part of the episodes that diverged, which score infinity. Lines stand in the order of "
    "`/ ekf`: the interquartile mean over all systems and episodes of log(NRMSE / the EKF's on the "
    "same episode), as a factor, with its 95 % bootstrap interval. Infinite scores count: they are "
    "trimmed only as part of the highest quarter. `better` is the part of the episodes with a "
    "smaller NRMSE than the EKF's. Offline estimators see the whole record first."
)
"""Explanation of the overview."""


def cells(found: Sequence[Line]) -> tuple[list[str], list[list[str]]]:
    """Return the overview's header and rows as text."""
    games = sorted({game for line in found for game in line.games}, key=label)
    header = ["estimator", "track", "/ ekf", "better", *map(label, games), "µs/step", "knows"]
    rows = []
    for line in found:
        shown = [_cell(line.games.get(game)) for game in games]
        ratio = "" if line.ratio is None else _factor(line.ratio)
        better = "" if line.better is None else f"{100 * line.better.value:.0f} %"
        rows.append(
            [
                *(line.estimator, line.track, ratio, better, *shown),
                *(number(line.us_per_step, 2), line.knows),
            ]
        )
    return header, rows


def rank_cells(found: Mapping[str, Mapping[str, int]]) -> tuple[list[str], list[list[str]]]:
    """Return the header and rows of the table of ranks as text: a column per estimator, sorted by
    worst rank, a row per condition, and a last row with the worst rank."""
    worst: dict[str, int] = {}
    total: dict[str, int] = defaultdict(int)
    for placed in found.values():
        for name, rank in placed.items():
            worst[name] = max(worst.get(name, 0), rank)
            total[name] += rank
    names = sorted(worst, key=lambda name: (worst[name], total[name]))
    rows = [
        [condition, *(str(placed.get(name, "")) for name in names)]
        for condition, placed in found.items()
    ]
    return ["condition", *names], [*rows, ["worst", *(str(worst[name]) for name in names)]]


RANK_NOTE = (
    "Rank of each online estimator under every condition, by the same interquartile mean; of those "
    "alone that played every system that the EKF did. Estimators stand in the order of their worst "
    "rank."
)
"""Explanation of the table of ranks."""


def markdown(found: Sequence[Line], placed: Mapping[str, Mapping[str, int]]) -> str:
    """Return the overview of `lines` in Markdown, followed by the table of `ranks` if it has
    several conditions."""
    parts = ["# Leaderboard\n", NOTE, "", text_table(*cells(found)), ""]
    if len(placed) > 1:
        parts += ["# Conditions\n", RANK_NOTE, "", text_table(*rank_cells(placed)), ""]
    return "\n".join(parts) + "\n"


def _cell(s: Standing | None) -> str:
    if s is None:
        return ""
    lost = f"div {s.diverged.percent.value:.0f} %" if s.diverged.value else ""
    median = number(s.nrmse.value) if np.isfinite(s.nrmse.value) else ""
    return ", ".join(filter(None, [median, lost]))


def _factor(ratio: Interval) -> str:
    if np.isnan(ratio.value):
        return "?"
    return f"{number(ratio.value, 2)} ({number(ratio.low, 2)}-{number(ratio.high, 2)})"
