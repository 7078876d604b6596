"""The charts of a page, and their data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from pinnobs_gym.leaderboard.display import one_line
from pinnobs_gym.leaderboard.site import comparisons, over_time
from pinnobs_gym.leaderboard.site.charts import Spec, Styled, nice_range
from pinnobs_gym.leaderboard.site.columns import Columns
from pinnobs_gym.leaderboard.site.games import GameResults
from pinnobs_gym.leaderboard.site.model import Page
from pinnobs_gym.leaderboard.site.palette import Style

COSTS = {"us": "CPU time per step and episode (µs)", "seconds": "CPU time of training (s)"}
"""Axis titles of the costs, by column."""

TABLES = (
    "settling",
    "ratios",
    "errors",
    "reference",
    "over_floor",
    "floor_errors",
    "floor_settling",
)
"""The tables of a game that its charts need, by the names of their fields."""


@dataclass(frozen=True)
class Charts:
    """Charts by name, and their data by key."""

    charts: dict[str, dict[str, Any]]
    """The charts, each with its ``spec``, the key of its ``data``, and its ``height``."""
    data: dict[str, dict[str, Columns]]
    """Tables by name. Their columns ``estimator`` are places in `names`."""
    names: list[str]
    """Names of the estimators in their order, then those of floors."""


def charts_of(page: Page, styles: Mapping[str, Style]) -> Charts:
    """Return all charts of a page: those across systems, and those of each game, whose names
    contain its number."""
    styled = Styled(styles, page.main.places.peer)
    parts = [_across(styled, page.costs)] if page.costs["estimator"] else []
    parts += [_game(styled, game) for section in page.sections for game in section.games]
    charts = {name: chart for part in parts for name, chart in part.charts.items()}
    data = {part.key: part.tables for part in parts}
    found = [table.get("estimator", []) for tables in data.values() for table in tables.values()]
    names = dict.fromkeys(chain(styles, *found))
    places = {name: i for i, name in enumerate(names)}
    packed = {
        key: {name: _packed(table, places) for name, table in tables.items()}
        for key, tables in data.items()
    }
    return Charts(charts, packed, [one_line(name) for name in names])


@dataclass(frozen=True)
class _Part:
    """Charts of the same data."""

    charts: dict[str, dict[str, Any]]
    """Charts as in `Charts`."""
    key: str
    """Key of their data."""
    tables: dict[str, Columns]
    """The tables by name, with the names of estimators."""


def embedded(charts: Charts, styles: Mapping[str, Style], chosen: Sequence[str]) -> str:
    """Return charts, data, styles and initially selected estimators as JSON for a script
    element."""
    places = {name: i for i, name in enumerate(styles)}
    everything = {
        "light": [style.light for style in styles.values()],
        "dark": [style.dark for style in styles.values()],
        "names": charts.names,
        "shown": [places[name] for name in chosen],
        "charts": charts.charts,
        "data": charts.data,
    }
    text = json.dumps(everything, separators=(",", ":"), ensure_ascii=False)
    return text.replace("<", "\\u003c")  # which could end the script element


def _across(styled: Styled, costs: Columns) -> _Part:
    """Return the charts across systems, for at least one estimator."""
    names, ratio = costs["estimator"], costs["ratio"]
    trained = [seconds is not None for seconds in costs["seconds"]]
    named = {
        "named_us": _labelled(costs["us"], ratio, costs["front"]),
        "named_seconds": _labelled(costs["seconds"], ratio, trained),
    }
    specs = {"factors": comparisons.factors(styled, names, *_range_of(costs, [True] * len(names)))}
    for field, title in COSTS.items():
        known = [value for value in costs[field] if value]
        if known:
            across = min(known) / 1.6, max(known) * 4
            up = _range_of(costs, [value is not None for value in costs[field]])
            specs[field] = comparisons.cost(styled, field, title, across, up)
    return _charts("across", specs, {"standings": costs | named})


def _game(styled: Styled, game: GameResults) -> _Part:
    """Return the charts of one game."""
    tables = {name: getattr(game, name) for name in TABLES}
    end = max([*game.errors["t"], *game.settling["t"], *game.floor_settling["t"], 1e-9])
    specs = {}
    if game.errors["t"]:
        lines = (game.errors, game.reference, game.floor_errors)
        seen = [value for table in lines for value in table["median"]]
        specs[f"errors{game.number}"] = over_time.errors(styled, end, *nice_range(seen, 1e-6, 3.0))
    specs[f"settling{game.number}"] = over_time.settling(styled, end)
    order = game.ratios["estimator"]
    if order:
        low, high = nice_range([*game.ratios["q10"], *game.ratios["q90"]], 0.01, 100.0)
        spec = comparisons.ratios(styled, order, min(low, 0.8), max(high, 2.0))
        specs[f"ratios{game.number}"] = spec
    if game.over_floor["estimator"]:
        order = list(dict.fromkeys(game.over_floor["estimator"]))
        seen = [
            1.0,
            *(value for part in ("ratio", "low", "high") for value in game.over_floor[part]),
        ]
        low, high = nice_range(seen, 0.1, 100.0)
        specs[f"over_floor{game.number}"] = comparisons.over_floor(styled, order, low, high)
    if game.states is not None:
        tables |= {"truth": game.states.truth, "estimates": game.states.estimates}
        for i, name in enumerate(game.states.names):
            measured, limits = f"y{i}" in game.states.truth, game.states.limits[i]
            shown = limits, measured, game.states.in_part
            spec = over_time.state(styled, i, name, end, *shown)
            specs[f"state{game.number}-{i}"] = spec
            of = game.states.error_limits
            largest = [of[each][i] if each in of else 1.0 for each in styled.places]
            spec = over_time.error(styled, i, end, largest)
            specs[f"error{game.number}-{i}"] = spec
    return _charts(f"game{game.number}", specs, tables)


def _charts(key: str, specs: Mapping[str, Spec], tables: Mapping[str, Columns]) -> _Part:
    """Return charts of the same data with their heights, so that the layout does not move when they
    are drawn."""
    charts = {
        name: {"spec": spec, "data": key, "height": spec["height"]} for name, spec in specs.items()
    }
    return _Part(charts, key, {**tables, "one": {"at": [1]}})


def _range_of(costs: Columns, wanted: Sequence[bool]) -> tuple[float, float]:
    """Return the range of an axis of factors: the intervals of the wanted ones, and 1."""
    parts = [costs[part] for part in ("ratio", "low", "high")]
    seen = [value for part in parts for value, want in zip(part, wanted, strict=True) if want]
    return nice_range([1.0, *seen], 0.02, 50.0)


def _labelled(x: Sequence[Any], y: Sequence[Any], wanted: Iterable[bool]) -> list[bool]:
    """Return which of the wanted points can be labelled without overlap, with the lowest points
    first; both axes are logarithmic."""
    places = {i: (np.log10(x[i] or 1.0), np.log10(y[i])) for i, want in enumerate(wanted) if want}
    spread = np.ptp(list(places.values()), axis=0) + 1e-9 if places else (1.0, 1.0)
    chosen: list[int] = []
    for i in sorted(places, key=lambda i: y[i]):
        gaps = [abs(np.subtract(places[i], places[j])) / spread for j in chosen]
        if all(gap[0] > 0.25 or gap[1] > 0.06 for gap in gaps):
            chosen.append(i)
    return [i in chosen for i in range(len(x))]


def _packed(table: Columns, places: Mapping[str, int]) -> Columns:
    """Return the columns with estimators as their places, and with other texts in one line."""
    packed = {
        name: [one_line(value) if isinstance(value, str) else value for value in column]
        for name, column in table.items()
    }
    if "estimator" in table:
        packed["estimator"] = [places[name] for name in table["estimator"]]
    return packed
