"""`evaluate ...`: score one estimator on one system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.cli.console import console, print_table, progress
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.video import check_video, write_video
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard import standings_table
from pinnobs_gym.leaderboard.against import compare, opponents
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.published.reading import PUBLISHED
from pinnobs_gym.leaderboard.published.trained import load_published
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.states_table import by_state
from pinnobs_gym.leaderboard.tables import tables
from pinnobs_gym.scoring.evaluation import (
    Evaluated,
    Results,
    make_estimator,
    run_episodes,
    seeds_of,
)
from pinnobs_gym.scoring.tensorboard import log_episodes, log_folder, log_summary
from pinnobs_gym.training.by_name import load
from pinnobs_gym.training.log import Log


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
        options = settings_of(cls, self.set)
        if self.video is not None:
            check_video(self.video)
        trained = self._trained(cls, game)
        estimator = make_estimator(trained or cls, game, options)
        episodes = 1 if game.source.deterministic else self.episodes
        if episodes < self.episodes:
            console.print(f"every episode of setup {self.setup!r} is the same: 1 is run")
        others = None
        if self.against is not None:
            others = opponents(self.against, game, seeds_of(self.seed, episodes))
        check_writable(self.out)
        evaluated = self._score(game, estimator, episodes)
        if others is None:
            for table in tables(contenders(runs_of(evaluated.rows))):
                hint = f"pinnobs tables {self._rows} -o FILE writes all"
                print_table(standings_table.layouts(table), hint)
        else:
            comparison = compare(evaluated.rows, others)
            hint = f"pinnobs tables {self._rows} {self.against} -o FILE writes all"
            print_table(standings_table.layouts(comparison.table), hint)
            console.print(comparison.summary + "\n", highlight=False)
        print_table([[by_state(game.source.system, evaluated.rows)]])
        # To draw takes as long as all else of one episode.
        drawn = evaluated.first_played if self.episodes > 1 else None
        with Log(log_folder(self.out, evaluated.rows[0])) as log:
            log_episodes(log, evaluated.rows, drawn)
            log_summary(log, evaluated.rows)
        console.print(f"rows: {self._rows}; TensorBoard: {self.out / 'tensorboard'}")
        if self.video is not None:
            write_video(self.video, estimator, game, self.seed)
            console.print(f"video: {self.video}", soft_wrap=True)
        return 0

    @property
    def _rows(self) -> Path:
        return self.out / "rows.jsonl"

    def _trained(self, cls: type[BaseEstimator], game: Game) -> BaseEstimator | None:
        """Return the trained estimator to score, None if it needs none."""
        if self.checkpoint == PUBLISHED:
            return load_published(self.estimator, game)
        return None if self.checkpoint is None else load(cls, self.checkpoint, game)

    def _score(self, game: Game, estimator: BaseEstimator, episodes: int) -> Evaluated:
        """Score this number of episodes."""
        seeds = seeds_of(self.seed, episodes)
        with progress() as bar:
            task = bar.add_task("episodes", total=episodes)

            def count(done: int) -> None:
                bar.advance(task, done)

            results = Results(self._rows, fresh=self.fresh)
            evaluated = run_episodes(game, estimator, seeds, results, count)
            bar.update(task, completed=episodes)
        if evaluated.reused:
            console.print(evaluated.reuse(self._rows), soft_wrap=True, highlight=False)
        return evaluated


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Evaluate, "evaluate", arguments).run()
