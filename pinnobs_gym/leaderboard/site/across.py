"""The numbers that the page shows across systems, from stored rows."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.site.data import Columns, extend, number
from pinnobs_gym.scoring.rows import Row


def standings(lines: Sequence[ranks.Line], players: Mapping[str, Any]) -> Columns:
    """Each line of the overview: its factor to the peer with the interval, its µs per step, and the
    CPU seconds that training took, a gap for those that are not trained. ``front`` is true of
    those that no other of their track beats in both accuracy and speed. Lines whose factor is not
    finite are left out."""
    table: Columns = {name: [] for name in ("estimator", "track", "ratio", "low", "high", "us")}
    table |= {"seconds": [], "front": []}
    for line in lines:
        if line.ratio is None or not np.isfinite(line.ratio.value):
            continue
        groups = players.get(line.estimator, {}).values()
        spent = [row["training"].get("seconds") for group in groups for row in group]
        known = [seconds for seconds in spent if seconds is not None]
        extend(
            table,
            estimator=[line.estimator],
            track=[line.track],
            ratio=[number(line.ratio.value)],
            low=[number(line.ratio.low)],
            high=[number(line.ratio.high)],
            us=[number(line.us_per_step)],
            seconds=[number(float(np.median(known))) if known else None],
            front=[not any(_beats(other, line) for other in lines)],
        )
    return table


def _beats(other: ranks.Line, line: ranks.Line) -> bool:
    """Whether the other is both faster and more accurate."""
    if other.ratio is None or line.ratio is None or other.track != line.track:
        return False
    faster = other.us_per_step < line.us_per_step
    return faster and other.ratio.value < line.ratio.value


def conditions(rows: Sequence[Row]) -> dict[str, dict[str, dict[str, float]]]:
    """`ranks.log_ratios` of all systems together, under the name "all systems", and of each; of
    those that were played under several conditions."""
    online = [row for row in rows if row["track"] == "online"]
    systems: dict[str, list[Row]] = defaultdict(list)
    for row in online:
        systems[row["env_id"].removeprefix("pinnobs/")].append(row)
    every = {"all systems": online} | (dict(sorted(systems.items())) if len(systems) > 1 else {})
    found = {name: ranks.log_ratios(some) for name, some in every.items()}
    return {name: values for name, values in found.items() if len(values) > 1}
