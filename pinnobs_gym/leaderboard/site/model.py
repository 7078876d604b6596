"""The page model: the content of the page, computed once from stored rows and curves."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.leaderboard import ranks
from pinnobs_gym.leaderboard.contenders import PEER, Contender, contenders
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.ranks import Line
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site.across import Factors, costs, factors, training_seconds
from pinnobs_gym.leaderboard.site.columns import Columns
from pinnobs_gym.leaderboard.site.games import GameResults, games_of
from pinnobs_gym.leaderboard.site.method import Method, method_of
from pinnobs_gym.scoring.rows import Stored
from pinnobs_gym.systems import SYSTEMS

SHOWN = 3
"""Number of the best online estimators that are selected initially, besides the peer."""


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
    chosen: tuple[str, ...]
    """The estimators selected initially in charts over time."""
    lines: tuple[Line, ...]
    """The overview across systems."""
    costs: Columns
    """The overview's factors and the estimators' costs; see `across.costs`."""
    sections: tuple[Section, ...]
    factors: tuple[Factors, ...]
    """Factors under each condition, over all systems and for each system."""
    method: Method


def page_model(stored: Stored, folders: Sequence[Path]) -> Page:
    """Compute the page model of stored scores.

    Args:
        stored: scored episodes, at least one, and failed jobs.
        folders: folders with the curves of these rows.

    Raises:
        ValueError: in one line, if a file of curves is damaged.
    """
    kept, notes = distinct(stored.rows)
    runs = runs_of(kept)
    compared = contenders(runs)
    lines = ranks.lines(compared)
    listed = _listed(compared, lines)
    seconds = {contender.name: training_seconds(contender) for contender in listed}
    return Page(
        tracks={contender.name: contender.track for contender in listed},
        chosen=_chosen(lines),
        lines=tuple(lines),
        costs=costs(lines, seconds),
        sections=tuple(_sections(games_of(listed, folders))),
        factors=tuple(factors(compared)),
        method=method_of(stored, listed, notes),
    )


def _listed(found: Iterable[Contender], lines: Iterable[Line]) -> list[Contender]:
    """Return contenders in the order of the overview's lines, with unlisted ones last."""
    by_name = {contender.name: contender for contender in found}
    order = dict.fromkeys([*(line.estimator for line in lines), *sorted(by_name)])
    return [by_name[name] for name in order]


def _chosen(lines: Iterable[Line]) -> tuple[str, ...]:
    """Return the best online estimators and the peer."""
    online = [line.estimator for line in lines if line.track == "online"]
    return tuple(dict.fromkeys([*online[:SHOWN], *(name for name in online if name == PEER)]))


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
