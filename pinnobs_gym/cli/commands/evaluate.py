"""`evaluate ...`: score one estimator on one system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pinnobs_gym.cli.console import console, print_next
from pinnobs_gym.cli.options import LOG_OPTIONS, check_apart, parse, settings_of
from pinnobs_gym.cli.own_model import ModelOptions
from pinnobs_gym.cli.scored import report, rows_file, with_progress
from pinnobs_gym.cli.video import check_video, write_video
from pinnobs_gym.envs.game import AnyGame, Game
from pinnobs_gym.envs.policy import WARNING, Policy, load_policy
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS, PREFIX, SUFFIX, policy_file
from pinnobs_gym.files import check_writable
from pinnobs_gym.leaderboard.against import opponents
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.published import manifest
from pinnobs_gym.leaderboard.published.manifest import Manifest
from pinnobs_gym.leaderboard.published.reading import PUBLISHED, published_floors
from pinnobs_gym.leaderboard.published.trained import load_published
from pinnobs_gym.registry import TRAINERS, trainer_class
from pinnobs_gym.scoring.evaluation import (
    Evaluated,
    Results,
    make_estimator,
    run_episodes,
    seeds_of,
)
from pinnobs_gym.scoring.log_evaluation import run_logs
from pinnobs_gym.scoring.log_game import LogGame
from pinnobs_gym.scoring.provenance import game_hash
from pinnobs_gym.training.by_name import check_times, load

_SIMULATED = ("--setup", "--condition", "--episodes", "--seed", "--video", "--tuned")
"""Options of simulated episodes."""


@dataclass(frozen=True)
class Evaluate:
    """Score one estimator on one system, episode by episode: on simulated episodes, or on sensor
    logs of which reference states are known."""

    system: str
    """Name or module:Class of the system."""
    estimator: str = "ekf"
    """Name or module:Class of the estimator; or policy:FILE.zip for a model that Stable-Baselines3
    saved. Such a file can hold code, which runs as it is loaded."""
    normalization: Path | None = None
    """Of a policy: the file of its VecNormalize. It can hold code, too."""
    trained: Path | None = None
    """Trained estimator to load; published stands for the one that ships with the package."""
    set: tuple[str, ...] = ()
    """Settings of the estimator, such as assumed_noise=0.1; of a policy that of its training, such
    as action_mode=gain."""
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
    log: tuple[Path, ...] = ()
    """Sensor logs to score in place of simulated episodes: CSV files as for pinnobs estimate, each
    with its reference."""
    reference: tuple[Path, ...] = ()
    """Reference states of each log, in the same order: CSV files with columns t and some of the
    states by name. Their times need not be those of the log, and empty cells do not count."""
    columns: tuple[str, ...] = ()
    """Columns of the logs under other names or in other units, such as t=millis*1e-3."""
    model: ModelOptions = field(default_factory=ModelOptions)
    """Of logs: what the model is told."""
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
        if self.tuned and (self.set or self.trained is not None):
            other = "--trained" if self.trained is not None else "--set"
            raise ValueError(f"--tuned and {other}; expected one of them")
        if (path := policy_file(self.estimator)) is not None:
            return self._run_policy(path)
        if self.estimator.startswith(PREFIX) or self.estimator.endswith(SUFFIX):
            raise ValueError(
                f"estimator {self.estimator!r}; a model of Stable-Baselines3 is given by "
                f"{PREFIX}FILE{SUFFIX}"
            )
        if self.normalization is not None:
            raise ValueError("--normalization without --estimator policy:FILE.zip")
        cls = ESTIMATORS.resolve(self.estimator)
        if cls.needs_training is not None and self.trained is None:
            trainer = TRAINERS.spec_of(trainer_class(cls))
            raise ValueError(
                f"estimator {self.estimator!r} has to be trained first: pinnobs train "
                f"{quoted(trainer)} --system {quoted(self.system)}; then give its file, "
                "--trained FILE"
            )
        if self.log:
            return self._run_logs(cls)
        game, options = self._game(), settings_of(cls, self.set)
        trained = self._trained(cls, game)
        return self._run_episodes(game, make_estimator(trained or cls, game, options, self.tuned))

    def _run_policy(self, path: Path) -> int:
        """Evaluate a model that Stable-Baselines3 saved, on simulated episodes."""
        for option, value in (
            ("--log", self.log),
            ("--trained", self.trained),
            ("--tuned", self.tuned),
        ):
            if value:
                raise ValueError(f"{option} and --estimator {self.estimator}; expected one of them")
        game, options = self._game(), settings_of(Policy, self.set)
        for each in filter(None, (path, self.normalization)):
            console.print(f"warning: {each} {WARNING}", style="yellow", soft_wrap=True)
        policy, normalize = load_policy(path, self.normalization)
        options |= {"normalize": normalize, "title": path.stem}
        return self._run_episodes(game, make_estimator(policy, game, options))

    def _game(self) -> Game:
        """Return the game that is played, after checks of what needs none of it."""
        if self.video is not None:
            check_video(self.video)
        return Game.of(self.system, self.setup, self.condition)

    def _run_episodes(self, game: Game, estimator: BaseEstimator) -> int:
        """Evaluate on simulated episodes."""
        episodes = 1 if game.source.deterministic else self.episodes
        if episodes < self.episodes:
            console.print(f"every episode of setup {self.setup!r} is the same: 1 is run")
        seeds = seeds_of(self.seed, episodes)
        score = partial(run_episodes, game, estimator, seeds)
        self._report(game, seeds, score, self.episodes > 1)
        if self.video is not None:
            write_video(self.video, estimator, game, self.seed)
            console.print(f"video: {self.video}", soft_wrap=True)
        self._say_next(game)
        return 0

    def _run_logs(self, cls: type[BaseEstimator]) -> int:
        """Evaluate on sensor logs."""
        if self.against == PUBLISHED:
            raise ValueError(
                "--against published and --log; expected a rows file with scores of the same logs"
            )
        system, setup = self.model.told(self.system)
        game = LogGame.of(system, setup, self.log, self.reference, self.columns)
        for note in game.notes:
            console.print(note, soft_wrap=True, highlight=False)
        trained = self._trained(cls, game)
        if trained is not None:
            for each in game.logs.values():
                check_times(trained, each.log.record, f"log {each.log.path}: {self.trained}")
        estimator = make_estimator(trained or cls, game, settings_of(cls, self.set))
        score = partial(run_logs, game, estimator)
        self._report(game, tuple(game.logs), score, picture=True)
        self._say_next(game)
        return 0

    def _report(
        self, game: AnyGame, seeds: Sequence[int], score: Callable[..., Evaluated], picture: bool
    ) -> None:
        """Run and report what ``score`` scores, which is given the stored rows and the progress."""
        others = None if self.against is None else opponents(self.against, game, seeds)
        shipped = published_floors([game.name])  # reject what is damaged before anything is run
        check_writable(self.out)
        run: Any = partial(score, Results(rows_file(self.out), fresh=self.fresh))
        evaluated = with_progress(len(seeds), run, phases=not self.log)
        report(game, evaluated, self.out, picture, others, shipped)

    def _say_next(self, game: AnyGame) -> None:
        """Print the command to type next: the same against what is published, if that is of the
        present code and can be compared; or all tables."""
        published = Manifest.read(manifest.FOLDER)
        entries = [] if published is None or self.against is not None else published.rows
        rows = [entry for entry in entries if entry.game == game.name and not entry.floor]
        if not any(entry.game_hash == game_hash(game.source) for entry in rows):
            print_next("tables", rows_file(self.out))
            return
        chosen = {
            "--setup": (self.setup, "benchmark"),
            "--condition": (self.condition, "nominal"),
            "--trained": (self.trained, None),
            "--normalization": (self.normalization, None),
            "--out": (self.out, Evaluate.out),
        }
        words = [
            word for name, (own, usual) in chosen.items() if own != usual for word in (name, own)
        ]
        words += ["--tuned"] * self.tuned + (["--set", *self.set] if self.set else [])
        estimator = ["--estimator", self.estimator]
        print_next("evaluate", "--system", self.system, *estimator, *words, "--against", PUBLISHED)

    def _trained(self, cls: type[BaseEstimator], game: AnyGame) -> BaseEstimator | None:
        """Return the trained estimator to score, None if it needs none."""
        if self.trained == PUBLISHED:
            return load_published(self.estimator, game)
        return None if self.trained is None else load(cls, self.trained, game)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    check_apart(arguments, _SIMULATED, ("--reference", *LOG_OPTIONS))
    return parse(Evaluate, "evaluate", arguments).run()
