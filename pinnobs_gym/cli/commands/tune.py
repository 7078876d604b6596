"""`tune NAME ...`: search an estimator's settings on a system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from pinnobs_gym.cli.console import console, progress
from pinnobs_gym.cli.options import parse
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.files import check_writable, file_name
from pinnobs_gym.scoring.tuning import Search, Tried


@dataclass(frozen=True)
class Tune:
    """Search an estimator's settings on episodes that the leaderboard never uses. Trials are
    stored, and an interrupted search continues."""

    name: Annotated[str, tyro.conf.Positional]
    """Name or module:Class of the estimator."""
    system: str
    """Name or module:Class of the system."""
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
    out: Path = Path("runs/tune")
    """Folder of the trials."""

    def run(self) -> int:
        """Search, and print the best settings."""
        if self.trials < 1:
            raise ValueError(f"trials={self.trials}; expected at least 1")
        cls = ESTIMATORS.resolve(self.name)
        game = Game.of(self.system, self.setup, self.condition)
        check_writable(self.out)
        path = self.out / f"{game.name.file_stem}-{file_name(ESTIMATORS.name_of(cls))}.journal"
        search = Search(cls, game, self.episodes, path, self.seed)
        if self.fresh:
            search.forget()
        done = search.done()
        if done:
            console.print(f"{done} trials taken from {path}", soft_wrap=True, highlight=False)
        default = Tried({}, search.error({}))
        console.print(f"default: geometric mean NRMSE {default.error:.4g}", highlight=False)
        stopped = False
        with progress() as bar:
            task = bar.add_task("trials", total=self.trials, completed=min(done, self.trials))

            def report(tried: Tried | None) -> None:
                best = search.best()
                shown = "" if best is None else f"trials, best {best.error:.4g}"
                bar.update(task, advance=1, description=shown)

            try:
                search.run(self.trials, report)
            except KeyboardInterrupt:
                stopped = True
        self._report(default, search.best())
        console.print(f"trials: {path}", soft_wrap=True)
        return 130 if stopped else 0

    def _report(self, default: Tried, best: Tried | None) -> None:
        if best is None or best.error >= default.error:
            console.print("nothing better than the default was found")
            return
        console.print(f"best:    geometric mean NRMSE {best.error:.4g}", highlight=False)
        console.print(arguments(best.settings), soft_wrap=True, highlight=False)


def arguments(settings: Mapping[str, Any]) -> str:
    """Format settings as command line arguments."""
    shown = (f"{n}={v:.4g}" if isinstance(v, float) else f"{n}={v}" for n, v in settings.items())
    return "--set " + " ".join(shown)


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Tune, "tune", arguments).run()
