"""The page itself: numbers and charts put into the template, all in one file."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from itertools import chain
from pathlib import Path
from typing import Any

import altair as alt
import jinja2
import numpy as np
import vl_convert
from markupsafe import Markup, escape

from pinnobs_gym import leaderboard, overview
from pinnobs_gym.conditions import CONDITIONS
from pinnobs_gym.overview import PEER
from pinnobs_gym.rows import Row
from pinnobs_gym.site import comparisons, data, method, over_time
from pinnobs_gym.site.charts import Spec, Styled, nice_range
from pinnobs_gym.site.data import Columns, Game
from pinnobs_gym.site.palette import styles
from pinnobs_gym.systems import SYSTEMS

SHOWN = 3
"""How many of the best online estimators are chosen at first, besides the peer."""


def build(rows: Sequence[Row], failures: Sequence[Row], folders: Sequence[Path]) -> str:
    """The page of these rows of scored episodes, at least one, of jobs that failed, and of the
    curves that are in the folders."""
    lines = overview.lines(rows)
    players = data.ordered(overview.contenders(rows), lines)
    games = data.games_of(players, folders)
    drawn = Drawings(list(players))
    drawn.compare(data.standings(lines, players))
    for number, game in enumerate(games):
        drawn.play(number, game)
    online = [line.estimator for line in lines if line.track == "online"]
    chosen = list(dict.fromkeys([*online[:SHOWN], *(name for name in online if name == PEER)]))
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["marked"] = _marked
    return environment.from_string(_text("page.html")).render(
        overview=overview.cells(lines),
        note=overview.NOTE,
        header=leaderboard.HEADER,
        cells=leaderboard.cells,
        systems=_systems(games),
        number_of={id(game): number for number, game in enumerate(games)},
        id=id,
        heat=[_heat(name, values) for name, values in data.conditions(rows).items()],
        methods=method.methods(players),
        failures=failures,
        versions=method.versions(rows),
        commands=method.commands(rows),
        dates=method.dates(rows),
        episodes=len(rows),
        styles=drawn.styles,
        tracks={
            name: next(chain.from_iterable(g.values()))["track"] for name, g in players.items()
        },
        charts=drawn.charts,
        css=Markup(_text("page.css")),
        vega=Markup(_bundle()),
        script=Markup(_text("page.js")),
        data=Markup(drawn.embedded(chosen)),
    )


class Drawings:
    """The charts of a page by name, and the data that they draw."""

    def __init__(self, names: Sequence[str]) -> None:
        self.styles = styles(names)
        self._styled = Styled(self.styles)
        self.charts: dict[str, dict[str, Any]] = {}
        self._data: dict[str, dict[str, Any]] = {}

    def embedded(self, chosen: Sequence[str]) -> str:
        """All of it as JSON, to stand in a script element, with the estimators chosen at first."""
        everything = {
            "light": [style.light for style in self.styles.values()],
            "dark": [style.dark for style in self.styles.values()],
            "shown": list(chosen),
            "charts": self.charts,
            "data": self._data,
        }
        return json.dumps(everything, separators=(",", ":"), ensure_ascii=False).replace(
            "</", "<\\/"
        )

    def compare(self, standings: Columns) -> None:
        """The charts across systems."""
        names = standings["estimator"]
        if not names:
            return
        self._data["across"] = {"standings": _packed(standings), "one": {"at": [1]}}
        up = _range_of(standings, [True] * len(names))
        standings = standings | {
            "named_us": _apart(standings["us"], standings["ratio"], standings["front"]),
            "named_seconds": _apart(
                standings["seconds"],
                standings["ratio"],
                [x is not None for x in standings["seconds"]],
            ),
        }
        self._data["across"]["standings"] = _packed(standings)
        self._add("factors", "across", comparisons.factors(self._styled, names, *up))
        titles = {"us": "CPU time per step and episode (µs)", "seconds": "CPU time of training (s)"}
        for field, title in titles.items():
            known = [value for value in standings[field] if value]
            if known:
                across = min(known) / 1.6, max(known) * 4
                up = _range_of(standings, [value is not None for value in standings[field]])
                spec = comparisons.cost(self._styled, field, title, across, up)
                self._add(field, "across", spec)

    def play(self, number: int, game: Game) -> None:
        """The charts of one game, their names ending in its number."""
        key = f"game{number}"
        parts = {
            name: getattr(game, name) for name in ("settling", "ratios", "errors", "reference")
        }
        if game.states is not None:
            parts |= {"truth": game.states.truth, "estimates": game.states.estimates}
        self._data[key] = {name: _packed(part) for name, part in parts.items()}
        self._data[key]["one"] = {"at": [1]}
        end = max([*game.errors["t"], *game.settling["t"], 1e-9])
        if game.errors["t"]:
            seen = [*game.errors["median"], *game.reference["median"]]
            spec = over_time.errors(self._styled, end, *nice_range(seen, 1e-6, 3.0))
            self._add(f"errors{number}", key, spec)
        self._add(f"settling{number}", key, over_time.settling(self._styled, end))
        order = game.ratios["estimator"]
        if order:
            seen = [*game.ratios["q10"], *game.ratios["q90"]]
            low, high = nice_range(seen, 0.01, 100.0)
            spec = comparisons.ratios(self._styled, order, min(low, 0.8), max(high, 2.0))
            self._add(f"ratios{number}", key, spec)
        if game.states is not None:
            for i, name in enumerate(game.states.names):
                measured = f"y{i}" in game.states.truth
                limits = game.states.limits[i]
                spec = over_time.state(self._styled, i, name, end, limits, measured)
                self._add(f"state{number}-{i}", key, spec)

    def _add(self, name: str, key: str, spec: Spec) -> None:
        """A chart, and how high it will be, so that nothing moves when it is drawn."""
        self.charts[name] = {"spec": spec, "data": key, "height": spec["height"] + 48}


def _range_of(standings: Columns, wanted: Sequence[bool]) -> tuple[float, float]:
    """What an axis of factors shows of those wanted: their intervals, and 1."""
    parts = [standings[part] for part in ("ratio", "low", "high")]
    seen = [value for part in parts for value, want in zip(part, wanted, strict=True) if want]
    return nice_range([1.0, *seen], 0.02, 50.0)


def _apart(x: Sequence[Any], y: Sequence[Any], wanted: Sequence[bool]) -> list[bool]:
    """Which of the points that want it can have a name beside them without one covering another,
    the lowest first; both axes are logarithmic."""
    places = {i: (np.log10(x[i] or 1.0), np.log10(y[i])) for i, want in enumerate(wanted) if want}
    spread = np.ptp(list(places.values()), axis=0) + 1e-9 if places else (1.0, 1.0)
    chosen: list[int] = []
    for i in sorted(places, key=lambda i: y[i]):
        gaps = [abs(np.subtract(places[i], places[j])) / spread for j in chosen]
        if all(gap[0] > 0.25 or gap[1] > 0.06 for gap in gaps):
            chosen.append(i)
    return [i in chosen for i in range(len(wanted))]


def _packed(table: Columns) -> dict[str, Any]:
    """Columns, those of estimators as numbers of a list."""
    packed: dict[str, Any] = dict(table)
    if "estimator" in table:
        levels = list(dict.fromkeys(table["estimator"]))
        place = {name: i for i, name in enumerate(levels)}
        packed["estimator"] = {
            "levels": levels,
            "codes": [place[name] for name in table["estimator"]],
        }
    return packed


def _systems(games: Sequence[Game]) -> dict[str, dict[str, Any]]:
    """What is told of each system and setup, and its games."""
    found: dict[str, dict[str, Any]] = {}
    known = {f"{name}-v{cls.version}": cls for name, cls in SYSTEMS.classes().items()}
    for game in games:
        title = game.system if game.setup == "benchmark" else f"{game.system}, {game.setup}"
        cls = known.get(game.system)
        about = (cls.__doc__ or "").strip().partition("\n")[0] if cls else ""
        place = {"anchor": re.sub(r"\W+", "-", title), "about": about, "games": []}
        found.setdefault(title, place)["games"].append(game)
    return found


def _heat(name: str, values: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """The table of factors under each condition: columns of estimators, those with the better worst
    rank first, and the worst rank of each."""
    ranks: dict[str, list[int]] = {}
    for column in values.values():
        for estimator, value in column.items():
            rank = 1 + sum(other < value for other in column.values())
            ranks.setdefault(estimator, []).append(rank)
    names = sorted(ranks, key=lambda n: (-len(ranks[n]), max(ranks[n]), sum(ranks[n])))
    lines = []
    for condition, column in values.items():
        parts = [CONDITIONS[part].summary for part in condition.split("+") if part in CONDITIONS]
        cells = [_heat_cell(column.get(name)) for name in names]
        lines.append({"condition": condition, "about": "; ".join(parts), "cells": cells})
    return {"name": name, "names": names, "lines": lines, "worst": [max(ranks[n]) for n in names]}


def _heat_cell(value: float | None) -> dict[str, Any]:
    """A cell's text, its side, and from 0 to 1 how strongly it is coloured: fully from a factor of
    four on."""
    if value is None:
        return {"text": "", "side": "none", "depth": 0.0}
    with np.errstate(over="ignore"):
        text = leaderboard.number(float(np.exp(value)), 2)
    depth = min(abs(value) / np.log(4), 1.0)
    return {"text": text, "side": "better" if value < 0 else "worse", "depth": round(depth, 2)}


def _marked(text: str) -> Markup:
    """Text whose parts in backticks are code."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


def _bundle() -> str:
    """Vega-Lite and all that it needs, to stand in a script element."""
    version = alt.SCHEMA_VERSION.removeprefix("v").rpartition(".")[0]
    if version not in vl_convert.get_vegalite_versions():
        version = vl_convert.get_vegalite_versions()[-1]
    bundle = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=version)
    return bundle.replace("</script", "<\\/script")


def _text(name: str) -> str:
    return resources.files("pinnobs_gym.site").joinpath(name).read_text(encoding="utf-8")
