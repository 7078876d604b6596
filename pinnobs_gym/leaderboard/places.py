"""Each estimator's factor to a common peer and its rank, over one game or several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.comparison import ROUNDING, interval, score
from pinnobs_gym.leaderboard.contenders import WINDOWS, Contender
from pinnobs_gym.leaderboard.influence import Results
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.tie_groups import ranks_of, tie_groups
from pinnobs_gym.scoring.tuned import SUFFIX

PEERS = ("ukf" + SUFFIX, "ukf")
"""The estimators with which all others are compared: of those that played the most episodes, the
one with the smaller steady errors. The tuned one is the worse of the two where a system is ranked
under another condition than that under which it was tuned, as the motor is."""
FEWEST = 50
"""Fewest episodes of a game that are ranked under a condition other than nominal and that which
the system is ranked under."""

FAR = 2.0
"""Factor to the error of the best of a rank above which an estimator that cannot be told from it
has no rank: its trainings or episodes are too few for how widely they differ."""

ITSELF = Interval(1.0, 1.0, 1.0)
"""The factor of the peer."""


@dataclass(frozen=True)
class Place:
    """The place of an estimator in one window."""

    factor: Interval
    """Its error over the peer's: the geometric mean over games of exp of the interquartile mean of
    log(NRMSE/NRMSE of the peer on the same episode), with a 95 % interval."""
    rank: int | None
    """Its rank within its track, which those that cannot be told apart share; None if it did not
    play all episodes that the peer played, there are too few of them, or they say too little about
    it (`FAR`)."""


@dataclass(frozen=True)
class Places:
    """The places of all estimators."""

    peer: str = ""
    """Name of the estimator that all are compared with; empty if there is none."""
    windows: Mapping[str, Mapping[str, Place]] = field(default_factory=dict)
    """By window and name."""
    left_out: tuple[GameName, ...] = ()
    """Games that are not compared, since states are not identifiable."""
    too_few: bool = False
    """Whether nothing is ranked because some game has fewer than `FEWEST` episodes."""

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
        rank = self.rank("steady", name)
        steady, transient = (self._factor(window, name) for window in WINDOWS)
        return np.inf if rank is None else rank, steady, transient

    def _factor(self, window: str, name: str) -> float:
        """Return the factor of an estimator in a window; infinite without a place."""
        place = self.place(window, name)
        return np.inf if place is None else place.factor.value


def places(contenders: Iterable[Contender]) -> Places:
    """Compare contenders over all of their games whose states are identifiable.

    Ranks are those of `tie_groups` within a track. Ranked are those that played every episode that
    the peer played, in every training; under conditions other than nominal and that which the
    system is ranked under there must be `FEWEST` episodes. Those that are `FAR` from the best of
    their rank have none.
    """
    players = list(contenders)
    games = dict.fromkeys(game for player in players for game in player.games)
    found = [player for player in players if _comparable(player)]
    compared = {game for player in found for game in _comparable(player)}
    left_out = tuple(game for game in games if game not in compared)
    peer = peer_of(found)
    if peer is None:
        return Places(left_out=left_out)
    windows = {}
    for window in WINDOWS:
        results = {contender.name: _results(contender, peer, window) for contender in found}
        factors = {
            name: ITSELF if name == peer.name else _factor(own)
            for name, own in results.items()
            if own
        }
        ranks: dict[str, int] = {}
        for track in dict.fromkeys(contender.track for contender in found):
            whole = [c.name for c in found if c.track == track and _complete(c, peer)]
            # Without an episode that all trainings of the peer played there are no results.
            ranked = {name: results[name] for name in whole if results[name]}
            ranks |= ranks_of([_near(group, factors) for group in tie_groups(ranked)])
        windows[window] = {name: Place(own, ranks.get(name)) for name, own in factors.items()}
    return Places(peer.name, windows, left_out, _too_few(peer))


def _near(group: Sequence[str], factors: Mapping[str, Interval]) -> list[str]:
    """Return those of a group whose error is not `FAR` from that of the group's best."""
    best = min(factors[name].value for name in group)
    return [name for name in group if factors[name].value <= FAR * best]


def peer_of(contenders: Sequence[Contender]) -> Contender | None:
    """Return the contender that all are compared with: one of `PEERS` or, if none of them played,
    the online one with the most rows; None if there is none."""
    online = [contender for contender in contenders if contender.track == "online"]
    named = [each for name in PEERS for each in online if each.name == name]
    if not named:
        return max(online, key=_num_rows, default=None)
    # Only one that played all that the other did, or else games would be left out.
    most = max(map(_num_rows, named))
    return min((each for each in named if _num_rows(each) == most), key=_steady)


def _num_rows(contender: Contender) -> int:
    return sum(len(run.rows) for run in contender.runs)


def _steady(contender: Contender) -> float:
    """Return the mean over comparable games of the mean log of the steady errors."""
    games = _comparable(contender)
    return float(np.mean([contender.errors[game].logs["steady"].mean() for game in games]))


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
    return not _too_few(peer) and all(
        game in contender.games
        and set(peer.errors[game].episodes) <= set(contender.errors[game].episodes)
        for game in _comparable(peer)
    )


def _too_few(peer: Contender) -> bool:
    """Return whether a game under another condition than nominal and that which its system is
    ranked under has too few episodes."""
    return any(
        len(peer.errors[game].episodes) < FEWEST
        for game in _comparable(peer)
        if game.condition != "nominal" and not peer.games[game][0].ranked
    )


def _factor(results: Mapping[str, Results]) -> Interval:
    """Return the geometric mean over games of the errors over the peer's, with its 95 % interval:
    from 0 to infinity where no difference could be significant at this level (`p_value`), so that
    it does not contradict the ranks; none if all errors are the peer's."""
    estimate = score(results)
    if estimate.standard_error <= ROUNDING and abs(estimate.value) <= ROUNDING:
        return ITSELF
    return interval(estimate).exp
