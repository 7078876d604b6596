"""Each estimator's factor to a common peer and its rank, over one game or several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.comparison import Results, score
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.tie_groups import ranks_of, tie_groups

PEER = "ukf"
"""The estimator with which all others are compared, if it played."""
FEWEST = 50
"""Fewest episodes of a game that are ranked under a condition other than nominal."""


@dataclass(frozen=True)
class Place:
    """The place of an estimator in one window."""

    factor: Interval
    """Its error over the peer's: the geometric mean over games of exp of the interquartile mean of
    log(NRMSE/NRMSE of the peer on the same episode), with a 95 % interval."""
    rank: int | None
    """Its rank within its track, which those that cannot be told apart share; None if it did not
    play all episodes that the peer played, or there are too few of them."""


@dataclass(frozen=True)
class Places:
    """The places of all estimators."""

    peer: str = ""
    """Name of the estimator that all are compared with; empty if there is none."""
    windows: Mapping[str, Mapping[str, Place]] = field(default_factory=dict)
    """By window and name."""

    def place(self, window: str, name: str) -> Place | None:
        """Return the place of an estimator in a window; None if it has none."""
        return self.windows.get(window, {}).get(name)

    def rank(self, window: str, name: str) -> int | None:
        """Return the rank of an estimator in a window; None if it has none."""
        place = self.place(window, name)
        return None if place is None else place.rank

    def order(self, name: str) -> tuple[float, float, float]:
        """Return the sort key of an estimator: by its steady rank, then by its steady factor, then
        by the transient one; those without come last."""
        found = [self.place(window, name) for window in WINDOWS]
        factors = [float("inf") if place is None else place.factor.value for place in found]
        rank = self.rank("steady", name)
        return (float("inf") if rank is None else rank, *factors)


def places(contenders: Iterable[Contender]) -> Places:
    """Compare contenders over all of their games whose states are identifiable.

    Ranks are those of `tie_groups` within a track. Ranked are those that played every episode that
    the peer played, in every training; under conditions other than nominal there must be `FEWEST`
    episodes.
    """
    found = [c for c in contenders if _comparable(c)]
    peer = peer_of(found)
    if peer is None:
        return Places()
    windows = {}
    for window in WINDOWS:
        results = {contender.name: _results(contender, peer, window) for contender in found}
        ranks: dict[str, int] = {}
        for track in dict.fromkeys(contender.track for contender in found):
            whole = [c.name for c in found if c.track == track and _complete(c, peer)]
            ranks |= ranks_of(tie_groups({name: results[name] for name in whole}))
        windows[window] = {
            name: Place(score(own).interval.exp, ranks.get(name))
            for name, own in results.items()
            if own
        }
    return Places(peer.name, windows)


def peer_of(contenders: Sequence[Contender]) -> Contender | None:
    """Return the contender that all are compared with: `PEER` or, if it did not play, the online
    one with the most rows; None if there is none."""
    online = [contender for contender in contenders if contender.track == "online"]
    named = [contender for contender in online if contender.name == PEER]
    return next(iter([*named, *online]), None)


def _comparable(contender: Contender) -> list[GameName]:
    """Return the games in which states are identifiable."""
    return [game for game, runs in contender.games.items() if runs[0].identifiable]


def _results(contender: Contender, peer: Contender, window: str) -> dict[str, Results]:
    """Return the results of each comparable game with episodes in common with the peer's."""
    results = {}
    for game in _comparable(contender):
        if game not in peer.games:
            continue
        own, theirs = contender.errors[game], peer.errors[game]
        played = set(own.episodes)
        common = [episode for episode in theirs.episodes if episode in played]
        if common:
            mine, reference = own.of(common), theirs.of(common).logs[window].mean(axis=0)
            results[" ".join(game)] = Results(mine.logs[window] - reference, mine.diverged)
    return results


def _complete(contender: Contender, peer: Contender) -> bool:
    """Return whether a contender played all that the peer did, and enough of it to be ranked."""
    for game in _comparable(peer):
        wanted = peer.errors[game].episodes
        if game not in contender.games or not set(wanted) <= set(contender.errors[game].episodes):
            return False
        if game.condition != "nominal" and len(wanted) < FEWEST:
            return False
    return True
