"""Jobs that compute the floor of some episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from pinnobs_gym.envs.game import Game
from pinnobs_gym.files import noticing_full_disks
from pinnobs_gym.leaderboard.jobs.time_limit import TIME_LIMIT
from pinnobs_gym.scoring.floor import run_floor

EPISODES = 10
"""Number of episodes of a job; an interrupted one is computed again."""


@dataclass(frozen=True)
class FloorJob:
    """The floor of some episodes of a game, for any process to compute."""

    game: Game
    """The game."""
    seed: int
    """Seed of the first episode."""
    episodes: int
    """Number of episodes."""
    folder: Path
    """Folder of the rows file."""
    fresh: bool = False
    """Whether stored episodes are computed again."""

    @property
    def rows(self) -> Path:
        """The rows file."""
        return self.folder / "rows.jsonl"

    @property
    def name(self) -> str:
        """Short description of the job."""
        system, condition = self.game.name.system, self.game.name.condition
        last = self.seed + self.episodes - 1
        return f"floor of {system}, {condition}, episodes {self.seed} to {last}"

    @property
    def time_limit(self) -> float:
        """Longest time in s that it may take in a worker."""
        return TIME_LIMIT

    def run(self) -> None:
        """Compute the missing rows and append them."""
        seeds = range(self.seed, self.seed + self.episodes)
        with noticing_full_disks():
            run_floor(self.game, seeds, self.rows, self.fresh)

    def anew(self) -> Self:
        """Return the same job: what it stored is not computed again."""
        return self

    def fail(self, error: str) -> None:
        """Record nothing: the job is run again the next time."""


def floor_jobs(
    games: Iterable[Game], seeds: range, folder: Path, fresh: bool
) -> Iterator[FloorJob]:
    """Yield the jobs of the floors of games, `EPISODES` episodes each."""
    for game in games:
        for first in range(seeds.start, seeds.stop, EPISODES):
            count = min(EPISODES, seeds.stop - first)
            yield FloorJob(game, first, count, folder, fresh)
