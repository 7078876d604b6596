"""Rendering of the page: its model and charts in the template, in one file."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import altair as alt
import jinja2
import numpy as np
import vl_convert
from markupsafe import Markup, escape

from pinnobs_gym.leaderboard import ranks_table, standings_table
from pinnobs_gym.leaderboard.board import Part
from pinnobs_gym.leaderboard.chapters import ON_RECORD
from pinnobs_gym.leaderboard.display import printable
from pinnobs_gym.leaderboard.grid import Grid
from pinnobs_gym.leaderboard.numerals import number
from pinnobs_gym.leaderboard.places import Place
from pinnobs_gym.leaderboard.site.across import Factors
from pinnobs_gym.leaderboard.site.drawings import charts_of, embedded
from pinnobs_gym.leaderboard.site.model import Page
from pinnobs_gym.leaderboard.site.palette import styles
from pinnobs_gym.leaderboard.tables import Table
from pinnobs_gym.simulation.conditions import CONDITIONS


def draw(page: Page) -> str:
    """Render the page as HTML; computes nothing from rows."""
    drawn = styles(list(page.tracks), page.main.places.peer)
    charts = charts_of(page, drawn)
    parts = filter(None, (page.main, page.on_record))
    facts = standings_table.facts_of(line.knows for part in parts for line in part.lines)
    scripts = _bundle(), _text("page.js")
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_visible,
    )
    environment.filters |= {"marked": _marked, "anchor": _anchor, "stacked": _stacked}
    environment.filters |= {"breakable": _breakable}
    return environment.from_string(_text("page.html")).render(
        page=page,
        overview=lambda part: _overview(part, facts),
        note=ranks_table.NOTE,
        on_record=ON_RECORD,
        grid=_standings,
        heat=[_heat(each, page.main.knows) for each in page.factors],
        styles=drawn,
        charts=charts.charts,
        css=Markup(_text("page.css")),
        policy=Markup(_policy(scripts)),
        scripts=[Markup(script) for script in scripts],
        newline=Markup("\n"),
        data=Markup(embedded(charts, drawn, page.chosen)),
    )


def _overview(part: Part, facts: Sequence[str]) -> Grid:
    """Return the overview of a part with a column per game, and letters for what estimators know,
    so that it fits a window of usual width.

    Args:
        part: the part.
        facts: what the letters stand for, the same in all parts of a page.
    """
    known = [line.knows for line in part.lines]
    whole = ranks_table.grid(part.lines, part.places.peer)
    return standings_table.with_letters(whole, known, facts)


def _standings(table: Table) -> Grid:
    """Return the table of a game with intervals, without columns that may be dropped and have no
    text in any line: a heading over nothing takes the room of numbers."""
    whole = standings_table.grid(table)
    names = [
        column.name
        for i, column in enumerate(whole.columns)
        if not column.priority or any(line[i] for line in whole.lines)
    ]
    return whole.only(names)


@dataclass(frozen=True)
class HeatCell:
    """The factor of one estimator to the peer, and its rank."""

    text: str
    side: str
    """``better`` or ``worse`` than the peer, or ``none`` if there is no factor."""
    depth: float
    """Colour intensity from 0 to 1."""


@dataclass(frozen=True)
class HeatLine:
    """The factors of all estimators under one condition."""

    condition: str
    remark: str
    """Which systems are left out; possibly empty."""
    about: str
    """Description of the condition."""
    cells: tuple[HeatCell, ...]


@dataclass(frozen=True)
class Heat:
    """The table of factors of one system, or of all systems."""

    name: str
    names: Sequence[str]
    """Names of the estimators."""
    lines: tuple[HeatLine, ...]
    worst: Sequence[int | None]
    """Worst rank of each estimator."""
    knows: Sequence[str]
    """What each estimator knows."""


def _heat(factors: Factors, knows: Mapping[str, Sequence[str]]) -> Heat:
    lines = tuple(_line(factors, condition) for condition in factors.values)
    known = tuple(", ".join(knows[name]) for name in factors.estimators)
    return Heat(factors.of, factors.estimators, lines, factors.worst, known)


def _line(factors: Factors, condition: str) -> HeatLine:
    values: Mapping[str, Place] = factors.values[condition]
    parts = [CONDITIONS[part].summary for part in condition.split("+") if part in CONDITIONS]
    cells = (_cell(values.get(name)) for name in factors.estimators)
    left_out = ", ".join(factors.left_out[condition])
    remark = f"without {left_out}" if left_out else ""
    return HeatLine(condition, remark, "; ".join(parts), tuple(cells))


def _cell(place: Place | None) -> HeatCell:
    """Return the cell of a place; factors of four and more have full colour."""
    if place is None:
        return HeatCell("", "none", 0.0)
    factor = place.factor.value
    depth = min(abs(np.log(factor)) / np.log(4), 1.0)
    return HeatCell(number(factor, 2), "better" if factor < 1 else "worse", round(depth, 2))


def _policy(scripts: Iterable[str]) -> str:
    """Return the content security policy of a page with these scripts: nothing else runs, code
    made of text included, and nothing is fetched or sent."""
    digests = [hashlib.sha256(script.encode()).digest() for script in scripts]
    sources = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return (
        f"default-src 'none'; style-src 'unsafe-inline'; script-src {sources}; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _visible(value: Any) -> Any:
    """Return a text that is no markup with nothing invisible in it, in one line."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return printable(re.sub(r"\s", " ", value))


def _marked(text: str) -> Markup:
    """Convert parts in backticks to code elements."""
    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(_visible(text)))))


def _stacked(text: str) -> Markup:
    """Put what is said of a number below it: its interval, or how many episodes diverged."""
    shown = _visible(text)
    if found := re.fullmatch(r"(\S+) (\([^()]*\))(.*)", shown):
        value, below, rest = map(escape, found.groups())
    elif found := re.fullmatch(r"(\S+), (div \d+ %)", shown):
        value, below, rest = *map(escape, found.groups()), ""
    else:
        return escape(shown)
    return Markup(f"{value}{rest} <small>{below}</small>")


def _breakable(text: str) -> Markup:
    """Let a line end within a name: before a capital, and after a hyphen or an underscore."""
    parts = re.split(r"(?<=[a-z])(?=[A-Z])|(?<=[-_/])", _visible(text))
    return Markup("<wbr>").join(map(escape, parts))


def _anchor(title: str) -> str:
    """Return the id of the section with that title, of no other title."""
    return re.sub(r"[^\w-]", lambda found: f".{ord(found[0]):x}.", title)


def _bundle() -> str:
    """Return Vega-Lite with its dependencies, escaped for a script element."""
    version = alt.SCHEMA_VERSION.removeprefix("v").rpartition(".")[0]
    if version not in vl_convert.get_vegalite_versions():
        version = vl_convert.get_vegalite_versions()[-1]
    bundle = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;", vl_version=version)
    return bundle.replace("</script", "<\\/script")


def _text(name: str) -> str:
    """Read a file from this module's folder."""
    folder = resources.files("pinnobs_gym.leaderboard.site")
    return folder.joinpath(name).read_text(encoding="utf-8")
