"""Search for an estimator's settings on episodes that are never scored."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.provenance import UNREADABLE, estimator_code, game_hash, unique
from pinnobs_gym.training.settings import SEEDS

if TYPE_CHECKING:
    import optuna
    from optuna.storages import JournalStorage

TUNING_SEED = 2 * 10**6
"""Seed of the first tuning episode; none of these episodes is scored."""
WINDOWS = ("steady", "transient")
"""The windows whose errors are searched for the least; those that a leaderboard ranks by."""
WORST = 10.0
"""NRMSE of a diverged episode in each window, and the largest NRMSE of the others."""
LEAST = 1e-12
"""The smallest NRMSE that counts, of an estimate that is exact."""
DIGITS = 4
"""Number of significant digits of settings that are tried, so that they are short to write."""


@dataclass(frozen=True)
class Tried:
    """Settings of an estimator, with the resulting error."""

    settings: Mapping[str, float]
    error: float
    """See `Search.error`."""


@dataclass(frozen=True)
class Search:
    """A search over the settings that an estimator class declares in `BaseEstimator.tunable`, by
    Optuna's tree-structured Parzen estimator (Bergstra et al. 2011).

    Searches of equal estimators and games continue each other. If the code of the estimator or of
    the game cannot be read, each search has trials of its own."""

    estimator: type[BaseEstimator]
    game: Game
    episodes: int
    """Number of episodes per trial, with seeds from `TUNING_SEED` on."""
    storage: Path
    """File to which every trial is written when it ends; a search continues from its content."""
    seed: int = 0
    """Seed of the search."""

    def __post_init__(self) -> None:
        check_searchable(self.estimator)
        if self.episodes < 1:
            raise ValueError(f"episodes={self.episodes}; expected at least 1")
        if self.seed not in range(SEEDS):
            raise ValueError(f"seed={self.seed}; expected a whole number from 0 to {SEEDS - 1}")

    def error(self, settings: Mapping[str, Any]) -> float:
        """Return the geometric mean of the NRMSE with these settings, over the episodes and the
        windows (`WINDOWS`), which thus count alike; see also `WORST`.

        Raises:
            ValueError: in one line, if the estimator does not accept the settings.
        """
        source = self.game.source
        estimator = self.estimator.for_setup(source.system, source.setup, **settings)
        seeds = range(TUNING_SEED, TUNING_SEED + self.episodes)
        played = play(self.game, estimator, seeds)
        scores = played.scores_alone
        nrmse = np.array([getattr(scores, f"nrmse_{window}") for window in WINDOWS])
        nrmse = np.where(scores.diverged, WORST, np.clip(nrmse, LEAST, WORST))
        return float(np.exp(np.mean(np.log(nrmse))))

    def run(self, trials: int, progress: Callable[[Tried | None], None]) -> None:
        """Try settings until the storage holds this number of trials. ``progress`` is called with
        each result, or with None for settings that the estimator rejects.

        Raises:
            ValueError: in one line, if Optuna is missing or the storage cannot be read.
        """
        study = self._study()
        import optuna

        while self.done() < trials:
            trial = study.ask()
            settings = _rounded(
                {
                    name: (
                        trial.suggest_int(name, int(bounds.low), int(bounds.high), log=bounds.log)
                        if bounds.whole
                        else trial.suggest_float(name, bounds.low, bounds.high, log=bounds.log)
                    )
                    for name, bounds in self.estimator.tunable.items()
                }
            )
            try:
                error = self.error(settings)
            except ValueError:
                study.tell(trial, state=optuna.trial.TrialState.PRUNED)
                progress(None)
            except KeyboardInterrupt:
                study.tell(trial, state=optuna.trial.TrialState.FAIL)
                raise
            else:
                study.tell(trial, error)
                progress(Tried(settings, error))

    def forget(self) -> None:
        """Delete the trials of this search from the storage."""
        self._study()
        import optuna

        optuna.delete_study(study_name=self._name, storage=self._journal())

    def done(self) -> int:
        """Return the number of finished trials in the storage."""
        ended = ("COMPLETE", "PRUNED")
        return sum(trial.state.name in ended for trial in self._study().trials)

    def best(self) -> Tried | None:
        """Return the best trial so far; None if no settings worked."""
        trials = self._study().trials
        tried = [Tried(_rounded(t.params), t.value) for t in trials if t.value is not None]
        return min(tried, key=lambda one: one.error, default=None)

    def _study(self) -> optuna.Study:
        try:
            import optuna
        except ImportError:
            raise ValueError(
                'tuning needs Optuna; install it with pip install "pinnobs-gym[tune]"'
            ) from None
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.storage.parent.mkdir(parents=True, exist_ok=True)
        try:
            study = optuna.create_study(
                storage=self._journal(), study_name=self._name, load_if_exists=True
            )
        except Exception as error:  # whatever a file that is no journal makes it raise
            raise ValueError(f"cannot read trials from {self.storage}: {error}") from None
        # A resumed search needs another stream of random numbers.
        study.sampler = optuna.samplers.TPESampler(seed=self.seed + len(study.trials))
        return study

    def _journal(self) -> JournalStorage:
        """Return Optuna's view of the storage."""
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        return JournalStorage(JournalFileBackend(str(self.storage)))

    @cached_property
    def _name(self) -> str:
        """The name of the study, common to its trials: those of other code are not continued. It is
        kept, since the hash of code that cannot be read is another each time."""
        code = estimator_code(self.estimator)
        hashes = (game_hash(self.game.source), unique() if code == UNREADABLE else code)
        what = (*self.game.name, ESTIMATORS.name_of(self.estimator), *hashes)
        what += (f"{self.episodes} episodes", *WINDOWS, str(dict(self.estimator.tunable)))
        return "-".join(what)


def check_searchable(cls: type[BaseEstimator]) -> None:
    """Check that an estimator has settings to search.

    Raises:
        ValueError: in one line, if it is trained or declares none.
    """
    name = ESTIMATORS.name_of(cls)
    if cls.needs_training or cls.trains_on_record:
        raise ValueError(f"estimator {name!r} is trained; its settings are not searched")
    if not cls.tunable:
        raise ValueError(f"estimator {name!r} declares no settings to search")


def _rounded(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of `DIGITS` significant digits."""
    return {
        name: float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
        for name, value in settings.items()
    }
