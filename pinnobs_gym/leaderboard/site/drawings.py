"""The charts of a page, and the data that they draw."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from pinnobs_gym.leaderboard.site import comparisons, over_time
from pinnobs_gym.leaderboard.site.charts import Spec, Styled, nice_range
from pinnobs_gym.leaderboard.site.data import Columns, Game
from pinnobs_gym.leaderboard.site.palette import styles


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
