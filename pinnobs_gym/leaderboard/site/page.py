"""The page itself: numbers and charts put into the template, all in one file."""

from __future__ import annotations

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

from pinnobs_gym.leaderboard import ranks, ranks_table, standings_table
from pinnobs_gym.leaderboard.ranks import PEER
from pinnobs_gym.leaderboard.site import across, data, method
from pinnobs_gym.leaderboard.site.data import Game
from pinnobs_gym.leaderboard.site.drawings import Drawings
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.simulation.conditions import CONDITIONS
from pinnobs_gym.systems import SYSTEMS

SHOWN = 3
"""How many of the best online estimators are chosen at first, besides the peer."""


def build(rows: Sequence[Row], failures: Sequence[Row], folders: Sequence[Path]) -> str:
    """The page of these rows of scored episodes, at least one, of jobs that failed, and of the
    curves that are in the folders."""
    lines = ranks.lines(rows)
    players = data.ordered(ranks.contenders(rows), lines)
    games = data.games_of(players, folders)
    drawn = Drawings(list(players))
    drawn.compare(across.standings(lines, players))
    for number, game in enumerate(games):
        drawn.play(number, game)
    online = [line.estimator for line in lines if line.track == "online"]
    chosen = list(dict.fromkeys([*online[:SHOWN], *(name for name in online if name == PEER)]))
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["marked"] = _marked
    return environment.from_string(_text("page.html")).render(
        overview=ranks_table.cells(lines),
        note=ranks_table.NOTE,
        header=standings_table.HEADER,
        cells=standings_table.cells,
        systems=_systems(games),
        number_of={id(game): number for number, game in enumerate(games)},
        id=id,
        heat=[_heat(name, values) for name, values in across.conditions(rows).items()],
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
        text = standings_table.number(float(np.exp(value)), 2)
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
    return (
        resources.files("pinnobs_gym.leaderboard.site").joinpath(name).read_text(encoding="utf-8")
    )
