"""`evaluate ...`: score one estimator on one system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pinnobs_gym.cli.console import console
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.scored import report, rows_file, with_progress
from pinnobs_gym.cli.video import check_video, write_video
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.against import opponents
from pinnobs_gym.leaderboard.published.reading import PUBLISHED, published_floors
from pinnobs_gym.leaderboard.published.trained import load_published
from pinnobs_gym.scoring.evaluation import (
    Results,
    make_estimator,
    run_episodes,
    seeds_of,
)
from pinnobs_gym.training.by_name import load


@dataclass(frozen=True)
class Evaluate:
    """Score one estimator on one system, episode by episode."""

    system: str
    """Name or module:Class of the system."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    checkpoint: Path | None = None
    """Trained estimator to load; published stands for the one that ships with the package."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as assumed_noise=0.1."""
    tuned: bool = False
    """Use the settings that pinnobs tune --store has stored with the system."""
    setup: str = "benchmark"
    """Setup to play."""
    condition: str = "nominal"
    """Condition, such as load_step, or noise5+dropout10."""
    episodes: int = 100
    """Number of episodes; of a single one TensorBoard has no picture."""
    seed: int = 0
    """Seed of the first episode."""
    fresh: bool = False
    """Run all episodes, also those whose scores are stored; the new scores replace them."""
    against: Path | None = None
    """Rows file among whose estimators this one is shown, on the same episodes; published stands
    for the rows that ship with the package."""
    out: Path = Path("runs/evaluate")
    """Folder of rows and TensorBoard log."""
    video: Path | None = None
    """Video of the first episode to write, NAME.mp4; needs the extra "video"."""

    def run(self) -> int:
        """Evaluate and print."""
        game = Game.of(self.system, self.setup, self.condition)
        cls = ESTIMATORS.resolve(self.estimator)
        if self.tuned and (self.set or self.checkpoint is not None):
            other = "--checkpoint" if self.checkpoint is not None else "--set"
            raise ValueError(f"--tuned and {other}; expected one of them")
        options = settings_of(cls, self.set)
        if self.video is not None:
            check_video(self.video)
        trained = self._trained(cls, game)
        estimator = make_estimator(trained or cls, game, options, self.tuned)
        episodes = 1 if game.source.deterministic else self.episodes
        if episodes < self.episodes:
            console.print(f"every episode of setup {self.setup!r} is the same: 1 is run")
        others = None
        if self.against is not None:
            others = opponents(self.against, game, seeds_of(self.seed, episodes))
        shipped = published_floors([game.name])  # reject what is damaged before anything is run
        check_writable(self.out)
        seeds = seeds_of(self.seed, episodes)
        results = Results(rows_file(self.out), fresh=self.fresh)
        score = partial(run_episodes, game, estimator, seeds, results)
        report(game, with_progress(episodes, score), self.out, self.episodes > 1, others, shipped)
        if self.video is not None:
            write_video(self.video, estimator, game, self.seed)
            console.print(f"video: {self.video}", soft_wrap=True)
        return 0

    def _trained(self, cls: type[BaseEstimator], game: Game) -> BaseEstimator | None:
        """Return the trained estimator to score, None if it needs none."""
        if self.checkpoint == PUBLISHED:
            return load_published(self.estimator, game)
        return None if self.checkpoint is None else load(cls, self.checkpoint, game)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Evaluate, "evaluate", arguments).run()
