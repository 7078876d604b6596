"""Jobs that compute the floor of some episodes."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from pinnobs_gym.envs.game import Game
from pinnobs_gym.files import noticing_full_disks
from pinnobs_gym.leaderboard.jobs.time_limit import TIME_LIMIT
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.evaluation import estimator_fields, game_fields
from pinnobs_gym.scoring.floor import floors_of, run_floor
from pinnobs_gym.scoring.recency import LastUse

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


def left(jobs: Sequence[FloorJob], stored: rows.Stored) -> list[FloorJob]:
    """Return the jobs with work left: an episode of which a floor is not stored, or code that was
    not the last to be used.

    A job looks itself, but each reads the whole file.
    """
    present = {rows.key(row) for row in stored.rows}
    last_use = LastUse.of([*stored.rows, *stored.uses])
    floors = {}
    for game in {job.game.name: job.game for job in jobs}.values():
        of_game = game_fields(game)
        floors[game.name] = [{**of_game, **estimator_fields(f, game)} for f in floors_of(game)]

    def is_done(job: FloorJob) -> bool:
        episodes = [rows.episode_of(job.seed + i) for i in range(job.episodes)]
        return not job.fresh and all(
            all(rows.key({**common, "episode": each}) in present for each in episodes)
            and last_use.is_last(common)
            for common in floors[job.game.name]
        )

    return [job for job in jobs if not is_done(job)]
