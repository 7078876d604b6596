"""Episodes that are simulated before they are played."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from itertools import chain, islice
from typing import Any, NamedTuple

import numpy as np

from pinnobs_gym.envs.episodes import Draws, Episodes, EpisodeSource, Stream

_SAMPLES_AHEAD = 65536
"""Largest number of samples simulated at a time when rows restart one by one."""
MOST_AHEAD = 8
"""Largest number of episodes of a row that are simulated at a time."""


class _Waiting(NamedTuple):
    """An episode that is not yet started."""

    draws: Draws
    """Its random numbers, without the noise, which takes as much memory as the outputs."""
    noise: Any
    """The state of the generator that draws the noise again."""
    episode: Episodes


class EpisodeBuffer:
    """Buffer of the next episodes of an env's rows, simulated before they are played.

    Simulating several episodes takes little longer than one. When rows restart one by one, a block
    of episodes is simulated at a time: one for each requested row and each other row without a
    waiting episode, and then further ones of the requested rows. Of a row these are 1, 2, 4 and so
    on up to `MOST_AHEAD` episodes at a time as they are played, and 1 again after a new seed.

    Args:
        source: source of the episodes.
        rows: number of rows.
        measured: whether `take` returns the outputs y and inputs u, of which records are made;
            otherwise they have no columns.
    """

    def __init__(self, source: EpisodeSource, rows: int, *, measured: bool) -> None:
        self._source = source
        self._measured = measured
        self._waiting: list[deque[_Waiting]] = [deque() for _ in range(rows)]
        self._ahead = [1] * rows

    def forget(self, rows: Iterable[int]) -> None:
        """Drop the waiting episodes of these rows, whose streams have changed."""
        for row in rows:
            self._waiting[row].clear()
            self._ahead[row] = 1

    def any(self, rows: Iterable[int]) -> bool:
        """Return whether any of these rows has an episode that is not yet started."""
        return any(self._waiting[row] for row in rows)

    def take(
        self, rows: Sequence[int], streams: Sequence[Stream], x0: np.ndarray | None = None
    ) -> Episodes:
        """Return the next episodes of these rows, from initial states (len(rows), nx) if given."""
        if x0 is not None:
            drawn = [self._drawn(row, streams[row]) for row in rows]
            return self._kept(self._source.play(_joined(drawn), x0))
        missing = [row for row in rows if not self._waiting[row]]
        if missing:
            self._simulate(self._block(missing), streams)
        taken = [self._waiting[row].popleft().episode for row in rows]
        if len(taken) == 1:
            return taken[0]
        parts = (np.concatenate([getattr(t, f.name) for t in taken], 1) for f in fields(Episodes))
        return Episodes(*parts)

    def _drawn(self, row: int, stream: Stream) -> Draws:
        """Return the draws of a row's next episode, waiting or not."""
        if not self._waiting[row]:
            return self._source.draw([stream])
        draws, state, _ = self._waiting[row].popleft()
        noise = np.empty((1, len(self._source.times), self._source.system.ny))
        again = np.random.default_rng(0)
        again.bit_generator.state = state
        again.standard_normal(out=noise[0])
        return replace(draws, noise=noise)

    def _block(self, missing: Sequence[int]) -> list[int]:
        """Return the rows whose episodes are simulated next, a row once for each, when these rows
        have none."""
        requested = set(missing)
        others = (r for r, queue in enumerate(self._waiting) if not queue and r not in requested)
        further = (r for i in range(1, MOST_AHEAD) for r in missing if i < self._ahead[r])
        size = max(len(missing), _SAMPLES_AHEAD // len(self._source.times))
        block = list(islice(chain(missing, others, further), size))
        for row in missing:
            self._ahead[row] = min(2 * self._ahead[row], MOST_AHEAD)
        return block

    def _simulate(self, block: Sequence[int], streams: Sequence[Stream]) -> None:
        """Simulate the next episodes of these rows."""
        states, drawn = [], []
        for row in block:
            states.append(streams[row].noise.bit_generator.state)
            drawn.append(self._source.draw([streams[row]]))
        played = self._kept(self._source.play(_joined(drawn)))
        for i, (row, draws, state) in enumerate(zip(block, drawn, states, strict=True)):
            # Copies: a view of the block would hold all of it.
            copies = (getattr(played, f.name)[:, i : i + 1].copy() for f in fields(Episodes))
            left = replace(draws, noise=draws.noise[:0].copy())
            self._waiting[row].append(_Waiting(left, state, Episodes(*copies)))

    def _kept(self, episodes: Episodes) -> Episodes:
        """Return what is kept of simulated episodes."""
        if self._measured:
            return episodes
        return replace(episodes, y=episodes.y[..., :0], u=episodes.u[..., :0])


def _joined(drawn: Sequence[Draws]) -> Draws:
    """Return the draws of several episodes as those of one batch."""
    seeds = tuple(seed for draws in drawn for seed in draws.seeds)
    x0, noise, u = (
        np.concatenate([getattr(draws, name) for draws in drawn]) for name in ("x0", "noise", "u")
    )
    return Draws(x0, noise, u, seeds)
