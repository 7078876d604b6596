"""`floor ...`: compute the floor of estimation errors."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.run_view import Kind, RunView
from pinnobs_gym.envs.game import Game
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.floor import is_floor
from pinnobs_gym.leaderboard.jobs.engine import Engine, Workers
from pinnobs_gym.leaderboard.jobs.floor_job import FloorJob, floor_jobs, left
from pinnobs_gym.leaderboard.jobs.stopping import stoppable
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.evaluation import seeds_of
from pinnobs_gym.scoring.exact_bayes import LEAST_ESS
from pinnobs_gym.scoring.floor import LARGEST, floors_of, too_few
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class FloorCommand:
    """Compute the floor of estimation errors: the posterior mean under the law of the episodes, of
    systems of up to three states, about 1 CPU-s an episode; with process noise, a large particle
    filter, about 10. What is stored is kept."""

    system: tuple[str, ...] = ()
    """Names or module:Class of systems; all built-in ones of up to three states if none is
    given."""
    condition: tuple[str, ...] = ("nominal",)
    """Conditions, such as nominal or noise5+dropout10."""
    setup: str = "benchmark"
    """Setup to play."""
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first episode."""
    jobs: int = 2
    """Number of processes, one thread each."""
    fresh: bool = False
    """Compute all episodes, also those that are stored; the new rows replace them."""
    out: Path = Path("runs/floor")
    """Folder of the rows file and of the curves; that of a leaderboard, to have the floor in its
    tables."""

    def run(self) -> int:
        """Compute what is missing."""
        if self.jobs < 1:
            raise ValueError(f"jobs={self.jobs}; expected at least 1")
        seeds = seeds_of(self.seed, self.episodes)
        games = [
            Game.of(name, self.setup, each) for name in self._systems for each in self.condition
        ]
        for game in games:
            floors_of(game)  # raises for a game without a floor, before anything is computed
        check_writable(self.out)
        path = self.out / "rows.jsonl"
        stored = rows.load(path)  # reject a damaged file
        earlier = {rows.key(row): row["date"] for row in stored.rows}
        jobs = list(floor_jobs(games, seeds, self.out.absolute(), self.fresh))
        failed = compute(left(jobs, stored), self.jobs)
        wanted = {game.name for game in games}
        found = [row for row in rows.read(path) if rows.game_of(row) in wanted and is_floor(row)]
        taken = sum(earlier.get(rows.key(row)) == row["date"] for row in found)
        if taken:
            console.print(
                f"{taken} of {len(found)} rows were in {path}", soft_wrap=True, highlight=False
            )
        few = too_few(found)
        if few:
            console.print(
                f"{len(few)} episodes have an effective sample size below {LEAST_ESS:.0f}; "
                "their posterior is not exact",
                style="yellow",
                soft_wrap=True,
            )
        console.print(f"rows: {path}", soft_wrap=True)
        print_next("evaluate", "--system", self._systems[0], "--out", self.out)
        return 1 if failed else 0

    @property
    def _systems(self) -> Sequence[str]:
        if self.system:
            return self.system
        return [name for name, cls in SYSTEMS.classes().items() if len(cls.state_names) <= LARGEST]


def compute(jobs: Sequence[FloorJob], processes: int) -> int:
    """Compute the floors of some jobs, show the progress, and return how many jobs failed."""
    if not jobs:
        return 0
    engine = Engine(Workers(processes))
    kinds = {job.name: Kind("floors", " ".join(job.game.name)) for job in jobs}
    with (
        stoppable(),
        RunView(list(kinds.values()), engine) as view,
        closing(engine.run(jobs)) as ended,
    ):
        for job, error, seconds in ended:
            view.ended(job.name, kinds[job.name], error, seconds)
    return view.failed


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(FloorCommand, "floor", arguments).run()
