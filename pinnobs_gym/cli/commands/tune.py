"""`tune NAME ...`: search the settings of estimators on systems."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from pinnobs_gym.cli.console import console, print_next, progress
from pinnobs_gym.cli.options import parse
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable, file_name
from pinnobs_gym.scoring.provenance import now, versions
from pinnobs_gym.scoring.tuned import changed_options
from pinnobs_gym.scoring.tuned_file import TunedEntry, path_of, store
from pinnobs_gym.scoring.tuning import WINDOWS, Search, Tried
from pinnobs_gym.simulation import notices
from pinnobs_gym.systems import SYSTEMS


@dataclass(frozen=True)
class Tune:
    """Search the settings of estimators on episodes that are never scored. What is searched for is
    the least geometric mean of the steady and the transient NRMSE. Trials are stored, and an
    interrupted search continues. Needs the extra "tune"."""

    names: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Names or module:Class of the estimators."""
    system: tuple[str, ...] = ()
    """Names or module:Class of systems; all of the package if not given."""
    setup: str = "benchmark"
    """Setup to play."""
    condition: str = "nominal"
    """Condition, such as load_step, or noise5+dropout10."""
    trials: int = 50
    """Number of settings to try, including those of earlier runs."""
    episodes: int = 32
    """Episodes of each trial."""
    seed: int = 0
    """Seed of the search."""
    fresh: bool = False
    """Search anew, without the trials of earlier runs."""
    store: bool = False
    """Store the best settings with the system, for pinnobs evaluate --tuned and the leaderboard.
    Without it, they are only printed."""
    out: Path = Path("runs/tune")
    """Folder of the trials."""

    def run(self) -> int:
        """Search, print the best settings, and store them if asked to."""
        if self.trials < 1:
            raise ValueError(f"trials={self.trials}; expected at least 1")
        if not self.names:
            raise ValueError("no estimator is given; expected NAME ..., see pinnobs tune --help")
        searches = self._searches()
        for i, search in enumerate(searches):
            if i:
                console.print()
            if not self._run(search):
                return 130
        first = searches[0]
        name, system = ESTIMATORS.spec_of(first.estimator), first.game.name.env_id
        best = first.best()
        if best is not None and best.settings and not self.store:
            given = [f"{key}={value}" for key, value in best.settings.items()]
            print_next("evaluate", "--system", system, "--estimator", name, "--set", *given)
        else:
            tuned = ["--tuned"] * (best is not None and bool(best.settings))
            print_next("evaluate", "--system", system, "--estimator", name, *tuned)
        return 0

    def _searches(self) -> list[Search]:
        """Return the searches, one for each estimator and system, after all have been checked.

        Raises:
            ValueError: in one line, before anything is run.
        """
        classes = [ESTIMATORS.resolve(name) for name in dict.fromkeys(self.names)]
        games = [
            Game.of(name, self.setup, self.condition)
            for name in dict.fromkeys(self.system or SYSTEMS.sources)
        ]
        check_writable(self.out)
        if self.store:
            if games[0].name.condition != "nominal":
                raise ValueError(
                    f"condition {self.condition!r} with --store; settings are stored for the "
                    "condition 'nominal' only"
                )
            for game in games:
                check_writable(path_of(type(game.source.system)).parent)
        searches = []
        for game in games:
            for cls in classes:
                path = f"{game.name.file_stem}-{file_name(ESTIMATORS.name_of(cls))}.journal"
                searches.append(Search(cls, game, self.episodes, self.out / path, self.seed))
                cls.for_setup(game.source.system, game.source.setup)  # it may not take the system
        return searches

    def _run(self, search: Search) -> bool:
        """Run one search, print its result, and store it if asked to; return whether the search was
        finished."""
        if self.fresh:
            search.forget()
        done = search.done()
        name, game = ESTIMATORS.name_of(search.estimator), search.game.name
        title = f"{name} on {game.system}, setup {game.setup}, condition {game.condition}"
        console.print(title, soft_wrap=True, highlight=False)
        if done:
            console.print(
                f"{done} trials taken from {search.storage}", soft_wrap=True, highlight=False
            )
        default = Tried({}, search.error({}))
        _print_error("default:", default)
        finished = self._search(search, done)
        best = search.best()
        if best is None or best.error >= default.error:
            nothing = "; nothing is stored" if self.store else ""
            console.print(f"nothing better than the default was found{nothing}")
        else:
            _print_error("best:", best)
            console.print(arguments(best.settings), soft_wrap=True, highlight=False)
            if self.store and finished:
                self._store(search, default, best)
        console.print(f"trials: {search.storage}", soft_wrap=True)
        return finished

    def _search(self, search: Search, done: int) -> bool:
        """Run the trials that are missing; return False if Ctrl-C stopped them."""
        with progress() as bar, _without_notices():
            task = bar.add_task("trials", total=self.trials, completed=min(done, self.trials))

            def report(tried: Tried | None) -> None:
                best = search.best()
                shown = "" if best is None else f"trials, best {best.error:.4g}"
                bar.update(task, advance=1, description=shown)

            try:
                search.run(self.trials, report)
            except KeyboardInterrupt:
                return False
        return True

    def _store(self, search: Search, default: Tried, best: Tried) -> None:
        """Store the settings with the system, if they are not the defaults."""
        if not changed_options(search.estimator, best.settings):
            console.print("these are the default settings; nothing is stored")
            return
        entry = TunedEntry(
            env_id=search.game.name.env_id,
            setup=search.game.name.setup,
            estimator=ESTIMATORS.spec_of(search.estimator),
            settings=best.settings,
            error=best.error,
            default_error=default.error,
            trials=search.done(),
            episodes=search.episodes,
            condition=search.game.name.condition,
            versions=versions(),
            date=now(),
        )
        path = store(type(search.game.source.system), entry)
        console.print(f"stored: {path}", soft_wrap=True, highlight=False)


def _print_error(what: str, tried: Tried) -> None:
    windows = " and ".join(WINDOWS)
    console.print(f"{what:8} geometric mean NRMSE {tried.error:.4g} ({windows})", highlight=False)


@contextmanager
def _without_notices() -> Iterator[None]:
    """Yield a context without lines about what estimators do with settings that are only tried."""
    logger = logging.getLogger(notices.__name__)
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def arguments(settings: Mapping[str, Any]) -> str:
    """Format settings as command line arguments."""
    return "--set " + " ".join(f"{name}={value}" for name, value in settings.items())


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Tune, "tune", arguments).run()
