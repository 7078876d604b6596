"""Which estimators apply to which games, by what they say that they take."""

from __future__ import annotations

from pinnobs_gym.envs.game import Game, GameName
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.takes import lacking
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.tuned import SUFFIX

NOT_APPLICABLE = "not applicable"
"""The cell of an estimator that does not take a game's system."""


def applies(cls: type[BaseEstimator], game: Game) -> bool:
    """Return whether an estimator takes what the system of a game has; see
    `BaseEstimator.takes`."""
    system, setup = game.source.system, game.source.setup
    return not lacking(cls, system, system.noise(setup.noise_std, setup.process_noise))


def cell_without_scores(estimator: str, game: GameName) -> str:
    """Return the cell of an estimator without scores in a game: `NOT_APPLICABLE` if it does not
    take the game's system; empty if it does, and if this process does not know both.

    Args:
        estimator: its name in rows.
        game: the game.
    """
    # Without the recipe of its training, and whether it is tuned.
    name = estimator.partition(" (")[0].removesuffix(SUFFIX)
    try:
        cls = ESTIMATORS.resolve(name)
        played = Game.of(game.env_id, game.setup, game.condition)
    except ValueError:
        return ""
    return "" if applies(cls, played) else NOT_APPLICABLE
