"""Columns of a game's charts from its rows: settling, and errors over the reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pinnobs_gym.leaderboard.site.columns import QUANTILES, Columns, extend, number, quantiles
from pinnobs_gym.leaderboard.standings import Standing, over_reference
from pinnobs_gym.scoring.rows import Row

STEPS = 100
"""Largest number of steps of a settling curve."""

Players = Mapping[str, Sequence[Row]]
"""Rows of one game by the contender's name."""


class _Ratios(NamedTuple):
    """One contender's errors over the reference."""

    estimator: str
    rms: float
    quantiles: np.ndarray


def settling(players: Players, until: float = 0.0) -> Columns:
    """Return, for every estimator, the ``share`` of its episodes that have settled by the time
    ``t`` in s; diverged episodes never settle. Values hold until the next time, the last ones until
    the last time of all or ``until``, in s, if that is later."""
    times = {name: _settled(rows) for name, rows in players.items()}
    last = max([until, *(float(t[-1]) for t in times.values() if len(t))])
    table: Columns = {"estimator": [], "t": [], "share": []}
    for name, settled in times.items():
        t, shares = _steps(settled, len(players[name]))
        extend(
            table,
            estimator=[name] * (len(t) + 1),
            t=[*t.tolist(), last],
            share=[*shares.tolist(), float(shares[-1])],
        )
    return table


def _settled(rows: Sequence[Row]) -> np.ndarray:
    """Return the settling times of the episodes that settled, in ascending order."""
    times = [row["settling"] for row in rows if not row["diverged"]]
    return np.sort([t for t in times if np.isfinite(t)])


def _steps(settled: np.ndarray, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return times, starting at 0, and the share of the episodes settled by then, in at most
    `STEPS` steps besides the start."""
    t, first = np.unique(settled, return_index=True)
    shares = np.append(first[1:], len(settled))[: len(t)] / episodes
    if len(t) > STEPS:
        chosen = np.unique(np.linspace(0, len(t) - 1, STEPS).round().astype(int))
        t, shares = t[chosen], shares[chosen]
    if not len(t) or t[0] > 0:
        t, shares = np.insert(t, 0, 0.0), np.insert(shares, 0, 0.0)
    return t, shares


def ratios(players: Players) -> Columns:
    """Return the ``rms`` of each estimator's NRMSE over the steady window, over that of the
    Cramér-Rao reference of the same episodes, and quantiles ``q10`` to ``q90`` of the ratios of
    single episodes; the smallest first."""
    spreads = []
    for name, rows in players.items():
        known = [row for row in rows if row["reference_steady"] is not None]
        if known:
            values = [row["nrmse_steady_modulo"] / row["reference_steady"] for row in known]
            spread = quantiles(np.array(values)[:, None])[:, 0]
            spreads.append(_Ratios(name, over_reference(known), spread))
    spreads.sort(key=lambda each: each.rms)
    table: Columns = {"estimator": [each.estimator for each in spreads]}
    table["rms"] = [number(each.rms) for each in spreads]
    for i, q in enumerate(QUANTILES):
        table[f"q{100 * q:.0f}"] = [number(each.quantiles[i]) for each in spreads]
    return table


def over_floor(standings: Mapping[str, Standing]) -> Columns:
    """Return the ``ratio`` of each estimator's error to the floor in each ``window``, with its
    interval ``low`` to ``high``; the smallest in the steady window first."""
    found = {
        name: {"steady": own.over_floor_steady, "transient": own.over_floor_transient}
        for name, own in standings.items()
    }
    first = {name: next(filter(None, own.values()), None) for name, own in found.items()}
    order = sorted((ratio.value, name) for name, ratio in first.items() if ratio is not None)
    table: Columns = {"estimator": [], "window": [], "ratio": [], "low": [], "high": []}
    for _, name in order:
        for window, ratio in found[name].items():
            if ratio is not None:
                extend(
                    table,
                    estimator=[name],
                    window=[window],
                    ratio=[number(ratio.value)],
                    low=[number(ratio.low)],
                    high=[number(ratio.high)],
                )
    return table
