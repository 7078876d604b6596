"""The numbers that the page shows of each game, from stored rows and curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pinnobs_gym.leaderboard import ranks, standings_table
from pinnobs_gym.scoring import curves
from pinnobs_gym.scoring.curves import Curves
from pinnobs_gym.scoring.rows import GameName, Row
from pinnobs_gym.scoring.thinning import kept

POINTS = 120
"""Most times that a curve is drawn at."""
STEPS = 100
"""Most steps of a settling curve."""
QUANTILES = (0.1, 0.25, 0.75, 0.9)

Columns: TypeAlias = dict[str, list[Any]]
"""A table by columns; None is a gap."""
Players: TypeAlias = Mapping[str, Sequence[Row]]
"""Rows by the estimator's name in the overview."""


@dataclass(frozen=True)
class Game:
    """One env, setup and condition."""

    env_id: str
    setup: str
    condition: str
    ranked: bool
    table: standings_table.Table
    settling: Columns
    """``estimator``, ``t`` in s, and ``share`` of its episodes that have settled by then."""
    ratios: Columns
    """Quantiles ``q10`` to ``q90`` of each estimator's NRMSE over the Cramér-Rao reference."""
    errors: Columns
    """``estimator``, ``t``, and ``median``, ``q10``, ``q90`` over episodes of a sample's NRMSE."""
    reference: Columns
    """``t`` and the ``median`` over episodes of what the Cramér-Rao reference expects."""
    states: States | None
    """The example episode; None without curves."""

    @property
    def system(self) -> str:
        """The env id without its namespace."""
        return self.env_id.removeprefix("pinnobs/")


@dataclass(frozen=True)
class States:
    """One episode, and what the estimators make of it."""

    seed: int
    names: tuple[str, ...]
    """Of the states, with units."""
    limits: tuple[tuple[float, float], ...]
    """What each state's axis shows."""
    truth: Columns
    """``t``, true states ``x0``, ...; outputs ``y0``, ... under the state that they measure."""
    estimates: Columns
    """``estimator``, ``t``, estimates ``m0``, ... and two of their standard deviations ``s0``, ...,
    gaps where it gives none."""


def ordered(
    players: Mapping[str, Mapping[str, Sequence[Row]]], lines: Iterable[ranks.Line]
) -> dict[str, Mapping[str, Sequence[Row]]]:
    """`ranks.contenders` in the order of the overview's lines; those that it does not list come
    last."""
    known = [line.estimator for line in lines if line.estimator in players]
    return {name: players[name] for name in dict.fromkeys([*known, *sorted(players)])}


def games_of(
    players: Mapping[str, Mapping[str, Sequence[Row]]], folders: Iterable[Path]
) -> list[Game]:
    """The games that systems are ranked under, each system's nominal ones after them."""
    folders = list(folders)
    played: dict[tuple[str, str, str], dict[str, list[Row]]] = defaultdict(dict)
    for name, games in players.items():
        for group in games.values():
            first = group[0]
            if first["ranked"] or first["condition"] == "nominal":
                key = (first["env_id"], first["setup"], first["condition"])
                played[key].setdefault(name, []).extend(group)
    ranked = {key: next(iter(game.values()))[0]["ranked"] for key, game in played.items()}
    order = sorted(played, key=lambda key: (key[:2], not ranked[key], key[2]))
    return [_game(key, ranked[key], played[key], folders) for key in order]


def _game(
    key: tuple[str, str, str], ranked: bool, players: Players, folders: Sequence[Path]
) -> Game:
    (table,) = standings_table.tables(row for rows in players.values() for row in rows)
    found = _curves(key, players, folders)
    return Game(
        *key,
        ranked=ranked,
        table=table,
        settling=settling(players),
        ratios=ratios(players),
        errors=errors(found),
        reference=reference(found.values()),
        states=states(found),
    )


def _curves(
    key: tuple[str, str, str], players: Players, folders: Sequence[Path]
) -> dict[str, Curves]:
    """Each estimator's curves of the episodes that have rows."""
    parts: dict[tuple[str, str], list[Curves]] = defaultdict(list)
    for folder in folders:
        for name, listed in curves.read(folder, GameName(*key)).items():
            parts[name] += listed
    found = {}
    for name, rows in players.items():
        hashes = {(row["estimator"], row["config_hash"]) for row in rows}
        own = [part for each in sorted(hashes) for part in parts.get(each, [])]
        merged = curves.merged(own, {row["episode_seed"] for row in rows})
        if merged is not None:
            found[name] = merged
    return found


def settling(players: Players) -> Columns:
    """For every estimator the share of its episodes that have settled against time; diverged ones
    never have. Steps hold until the next."""
    table: Columns = {"estimator": [], "t": [], "share": []}
    last = 0.0
    times = {}
    for name, rows in players.items():
        own = [row["settling"] for row in rows if not row["diverged"]]
        times[name] = np.sort([t for t in own if np.isfinite(t)])
        last = max(last, *times[name].tolist(), 0.0)
    for name, t in times.items():
        count = len(players[name])
        ends, index = np.unique(t, return_index=True)
        shares = np.append(index[1:], len(t))[: len(ends)] / count
        if len(ends) > STEPS:
            chosen = np.unique(np.linspace(0, len(ends) - 1, STEPS).round().astype(int))
            ends, shares = ends[chosen], shares[chosen]
        final = shares[-1] if len(shares) else 0.0
        if not len(ends) or ends[0] > 0:
            ends, shares = np.insert(ends, 0, 0.0), np.insert(shares, 0, 0.0)
        extend(
            table,
            estimator=[name] * (len(ends) + 1),
            t=[*ends.tolist(), last],
            share=[*shares.tolist(), final],
        )
    return table


def ratios(players: Players) -> Columns:
    """Quantiles of each estimator's NRMSE over the Cramér-Rao reference of the same episode, the
    smallest median first."""
    found = []
    for name, rows in players.items():
        values = np.array([v for v in (row["reference_ratio"] for row in rows) if v is not None])
        if len(values):
            found.append((float(np.median(values)), name, _quantiles(values[:, None])[:, 0]))
    found.sort(key=lambda line: line[0])
    table: Columns = {"estimator": [name for _, name, _ in found]}
    table["median"] = [number(median) for median, _, _ in found]
    for i, q in enumerate(QUANTILES):
        table[f"q{100 * q:.0f}"] = [number(values[i]) for _, _, values in found]
    return table


def errors(found: Mapping[str, Curves]) -> Columns:
    """Median and 10-90 % band over episodes of each estimator's error over time."""
    table: Columns = {"estimator": [], "t": [], "median": [], "q10": [], "q90": []}
    for name, own in found.items():
        k = kept(len(own.t), POINTS)
        k = k[~np.isnan(own.error[:, k]).all(axis=0)]
        error = own.error[:, k].astype(float)
        quantiles = _quantiles(error)
        extend(
            table,
            estimator=[name] * len(k),
            t=numbers(own.t[k]),
            median=numbers(_median(error)),
            q10=numbers(quantiles[0]),
            q90=numbers(quantiles[-1]),
        )
    return table


def reference(found: Iterable[Curves]) -> Columns:
    """Median over all episodes of the error at the Cramér-Rao reference."""
    episodes: dict[int, np.ndarray] = {}
    t = np.empty(0)
    for own in found:
        if own.reference is None or (len(t) and len(own.t) != len(t)):
            continue
        t = own.t
        for seed, line in zip(own.seeds.tolist(), own.reference, strict=True):
            episodes.setdefault(seed, line)
    if not episodes:
        return {"t": [], "median": []}
    k = kept(len(t), POINTS)
    lines = np.stack(list(episodes.values()))[:, k].astype(float)
    some = ~np.isnan(lines).all(axis=0)
    return {"t": numbers(t[k][some]), "median": numbers(_median(lines[:, some]))}


def states(found: Mapping[str, Curves]) -> States | None:
    """The first episode that most estimators have as their example."""
    seeds = [own.example.seed for own in found.values()]
    if not seeds:
        return None
    seed = max(sorted(set(seeds)), key=seeds.count)
    shown = {name: own for name, own in found.items() if own.example.seed == seed}
    first = next(iter(shown.values()))
    x, y = first.example.x, first.example.y
    truth: Columns = {"t": numbers(first.example.t)}
    truth |= {f"x{i}": numbers(x[:, i]) for i in range(x.shape[1])}
    truth |= {f"y{i}": numbers(y[:, output]) for i, output in first.measured.items()}
    table: Columns = {"estimator": [], "t": []}
    table |= {f"{part}{i}": [] for i in range(x.shape[1]) for part in ("m", "s")}
    for name, own in shown.items():
        t, mean, std = own.example.t, own.example.xhat, own.example.std
        parts = {"m": mean, "s": np.full(mean.shape, np.nan) if std is None else 2 * std}
        new = {f"{p}{i}": numbers(v[:, i]) for p, v in parts.items() for i in range(x.shape[1])}
        extend(table, estimator=[name] * len(t), t=numbers(t), **new)
    return States(
        seed, first.states, tuple(_limits(x[:, i]) for i in range(x.shape[1])), truth, table
    )


def _limits(x: np.ndarray) -> tuple[float, float]:
    low, high = float(x.min()), float(x.max())
    margin = 0.15 * (high - low) + 1e-9 * max(abs(low), abs(high), 1.0)
    return low - margin, high + margin


def _median(values: np.ndarray) -> np.ndarray:
    """Medians of columns, what is not a number left out; infinite values count."""
    ordered, count = _sorted(values)
    middle = np.stack([(count - 1) // 2, count // 2])
    return np.take_along_axis(ordered, middle, axis=0).mean(axis=0)


def _quantiles(values: np.ndarray) -> np.ndarray:
    """`QUANTILES` of columns, each a value that occurs, what is not a number left out."""
    ordered, count = _sorted(values)
    places = np.ceil(np.multiply.outer(QUANTILES, count) - 1e-9).astype(int) - 1
    return np.take_along_axis(ordered, np.maximum(places, 0), axis=0)


def _sorted(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns in ascending order, and how many of each are numbers; these come first."""
    return np.sort(values, axis=0), (~np.isnan(values)).sum(axis=0)


def extend(table: Columns, **new: list[Any]) -> None:
    """Add to the columns of a table."""
    for name, values in new.items():
        table[name] += values


def numbers(values: np.ndarray) -> list[float | None]:
    """Each as `number` gives it."""
    return [number(value) for value in np.asarray(values, dtype=float).tolist()]


def number(value: float) -> float | None:
    """Four significant digits; what is not finite is a gap."""
    return float(f"{value:.4g}") if np.isfinite(value) else None
