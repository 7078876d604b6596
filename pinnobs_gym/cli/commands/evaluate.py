"""`evaluate ...`: score one estimator on one system."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pinnobs_gym.cli.console import console, print_table, progress
from pinnobs_gym.cli.options import parse, settings_of
from pinnobs_gym.cli.video import check_video, write_video
from pinnobs_gym.envs.registration import env_id, make_vector_env
from pinnobs_gym.estimation.estimator import Estimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard import standings_table
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.scoring import tensorboard
from pinnobs_gym.scoring.evaluation import Results, run_episodes
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.scoring.tensorboard import log_episodes, log_summary
from pinnobs_gym.training import by_name
from pinnobs_gym.training.log import Log


@dataclass(frozen=True)
class Evaluate:
    """Score one estimator on one system, episode by episode."""

    system: str
    """Name or module:Class of the system."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator."""
    checkpoint: Path | None = None
    """Trained estimator to load."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as process_noise=1e-3."""
    setup: str = "benchmark"
    """Setup that is played."""
    condition: str = "nominal"
    """Condition, such as load_step, or noise5+dropout10."""
    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the first."""
    out: Path = Path("runs/evaluate")
    """Folder of rows and TensorBoard log."""
    video: Path | None = None
    """Video of the first episode to write, NAME.mp4; needs the extra "video"."""

    def run(self) -> int:
        """Evaluate and print."""
        name = env_id(self.system)
        cls = ESTIMATORS.resolve(self.estimator)
        estimator: Estimator | type[Estimator] = cls
        options = settings_of(cls, self.set)
        if self.video is not None:
            check_video(self.video)
        source = make_vector_env(name, 1, self.setup, self.condition).source
        if self.checkpoint is not None:
            estimator = by_name.load(cls, self.checkpoint, source.system, source.setup)
        episodes = 1 if source.deterministic else self.episodes
        if episodes < self.episodes:
            console.print(f"every episode of setup {self.setup!r} is the same: 1 is run")
        check_writable(self.out)
        scored, made = self._score(estimator, name, episodes, options)
        for table in standings_table.tables(runs_of(scored)):
            print_table(table)
        console.print(f"rows: {self._rows}; TensorBoard: {self.out / 'tensorboard'}")
        if self.video is not None:
            write_video(self.video, made, name, self.setup, self.condition, self.seed)
            console.print(f"video: {self.video}", soft_wrap=True)
        return 0

    @property
    def _rows(self) -> Path:
        return self.out / "rows.jsonl"

    def _score(
        self,
        estimator: Estimator | type[Estimator],
        name: str,
        episodes: int,
        options: dict[str, Any],
    ) -> tuple[list[Row], Estimator]:
        """The rows of that many episodes, logged, and the estimator that was scored."""
        seeds = range(self.seed, self.seed + episodes)
        game = (self.setup, self.condition)
        with progress() as bar:
            task = bar.add_task("episodes", total=episodes)

            def told(done: int) -> None:
                bar.advance(task, done)

            scored, made, example = run_episodes(
                estimator, name, seeds, *game, options, Results(self._rows), told
            )
            bar.update(task, completed=episodes)
        with Log(tensorboard.log_folder(self.out, scored[0])) as log:
            log_episodes(log, scored, made, example)
            log_summary(log, scored)
        return scored, made


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns its exit status."""
    return parse(Evaluate, "evaluate", arguments).run()
