"""The page model: the content of the page, computed once from stored rows and curves."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.board import Part, board
from pinnobs_gym.leaderboard.contenders import Contender
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.site.across import Factors, costs, factors, training_seconds
from pinnobs_gym.leaderboard.site.columns import Columns
from pinnobs_gym.leaderboard.site.games import GameResults, games_of
from pinnobs_gym.leaderboard.site.method import Method, method_of
from pinnobs_gym.scoring.rows import Row, Stored
from pinnobs_gym.systems import SYSTEMS

SHOWN = 3
"""Number of the best online estimators that are selected initially, besides the peer."""


@dataclass(frozen=True)
class About:
    """What an estimator is."""

    name: str
    """Its name, without its settings."""
    first: str
    """The first contender of this name."""
    what: str
    """One line."""


@dataclass(frozen=True)
class Section:
    """The games of one system and setup."""

    title: str
    about: str
    """One sentence about the system."""
    games: tuple[GameResults, ...]


@dataclass(frozen=True)
class Page:
    """The content of the page."""

    tracks: Mapping[str, str]
    """Track of each estimator, in display order."""
    abouts: tuple[About, ...]
    """What estimators are, in display order."""
    chosen: tuple[str, ...]
    """The estimators selected initially in charts over time."""
    main: Part
    """Estimators that are made before any scored record is seen."""
    on_record: Part | None
    """Estimators that are trained on each record; None if there are none."""
    costs: Columns
    """The overview's factors and the estimators' costs; see `across.costs`."""
    sections: tuple[Section, ...]
    factors: tuple[Factors, ...]
    """Factors under each condition, over all systems and for each system."""
    method: Method


def page_model(stored: Stored, folders: Sequence[Path], shipped: Sequence[Row] = ()) -> Page:
    """Compute the page model of stored scores.

    Args:
        stored: scored episodes, at least one, and failed jobs.
        folders: folders with the curves of these rows.
        shipped: further rows of floors (`pinnobs_gym.leaderboard.floor.floors`).

    Raises:
        ValueError: in one line, if a file of curves is damaged.
    """
    results = board(stored, shipped)
    main, on_record = results.main, results.on_record
    listed = _listed(main.contenders, main.lines)
    others = [] if on_record is None else _listed(on_record.contenders, on_record.lines)
    others = [each for each in others if each.name not in {c.name for c in listed}]
    seconds = {contender.name: training_seconds(contender) for contender in main.compared}
    drawn = [*listed, *others]
    tables = {table.game: table for part in results.parts[::-1] for table in part.tables}
    return Page(
        tracks={contender.name: contender.track for contender in drawn},
        abouts=tuple(abouts(drawn)),
        chosen=_chosen(main.lines, main.places.peer),
        main=main,
        on_record=on_record,
        costs=costs(main.lines, seconds),
        sections=tuple(_sections(games_of(drawn, tables.values(), folders, results.floors))),
        factors=tuple(factors(main.compared, main.conditions)),
        method=method_of(stored, drawn, results),
    )


def _listed(found: Iterable[Contender], lines: Iterable[Line]) -> list[Contender]:
    """Return contenders in the order of the overview's lines, with unlisted ones last."""
    by_name = {contender.name: contender for contender in found}
    order = dict.fromkeys([*(line.estimator for line in lines), *sorted(by_name)])
    return [by_name[name] for name in order]


def abouts(found: Iterable[Contender]) -> list[About]:
    """Return what estimators are, one for all that differ in settings or training."""
    named: dict[str, About] = {}
    for contender in found:
        name = contender.name.partition(" (")[0].partition(", ")[0]
        named.setdefault(name, About(name, contender.name, _what(name, contender)))
    return list(named.values())


def _what(name: str, contender: Contender) -> str:
    """Return in one line what an estimator is, as far as this process knows it by its name; nothing
    that rows name is imported."""
    cls = ESTIMATORS.classes().get(name)
    if cls is not None:
        return " ".join((inspect.getdoc(cls) or "").partition("\n\n")[0].split())
    spec = str(contender.runs[0].rows[0].get("made_by", {}).get("estimator", ""))
    return f"not of this installation: {spec}" if spec else "not of this installation"


def _chosen(lines: Iterable[Line], peer: str) -> tuple[str, ...]:
    """Return the best online estimators and the peer."""
    online = [line.estimator for line in lines if line.track == "online"]
    return tuple(dict.fromkeys([*online[:SHOWN], *(name for name in online if name == peer)]))


def _sections(games: Iterable[GameResults]) -> list[Section]:
    """Group the games by system and setup."""
    known = {f"{name}-v{cls.version}": cls for name, cls in SYSTEMS.classes().items()}
    grouped: dict[tuple[str, str], list[GameResults]] = {}
    for each in games:
        grouped.setdefault((each.game.system, each.game.setup), []).append(each)
    sections = []
    for (system, setup), some in grouped.items():
        cls = known.get(system)
        about = (cls.__doc__ or "").strip().partition("\n")[0] if cls else ""
        title = system if setup == "benchmark" else f"{system}, {setup}"
        sections.append(Section(title, about, tuple(some)))
    return sections
