"""Settings of estimators that were found by a search, and are stored with a system.

An estimator that has them (`pinnobs_gym.scoring.tuned_file`), and no other settings that are not
the defaults of its class, is called *tuned* in rows and tables.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING
from typing import Any

from pinnobs_gym.envs.game import AnyGame
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.provenance import canonical
from pinnobs_gym.scoring.tuned_file import TunedEntry, path_of, read
from pinnobs_gym.scoring.tuning import check_searchable
from pinnobs_gym.systems import SYSTEMS

TUNED = "tuned"
"""What `BaseEstimator.knows` has in rows of an estimator with tuned settings."""
SUFFIX = f", {TUNED}"
"""What follows the name of such an estimator in rows."""


def tuned_settings(cls: type[BaseEstimator], game: AnyGame) -> dict[str, Any] | None:
    """Return the settings of an estimator that are stored with the system of a game for its setup.
    None if there are none, or all are the defaults of the class.

    Raises:
        ValueError: in one line that names the file, if it is damaged.
    """
    key = game.name.env_id, game.name.setup, ESTIMATORS.spec_of(cls)
    for entry in entries_of(game):
        if entry.key == key and changed_options(cls, entry.settings):
            return dict(entry.settings)
    return None


def entries_of(game: AnyGame) -> tuple[TunedEntry, ...]:
    """Return all that is stored with the system of a game, for any setup; nothing with a system
    that is not defined in a file.

    Raises:
        ValueError: in one line that names the file, if it is damaged.
    """
    try:
        path = path_of(type(game.source.system))
    except ValueError:
        return ()
    return read(path)


def required_settings(cls: type[BaseEstimator], game: AnyGame) -> dict[str, Any]:
    """Return the `tuned_settings` of an estimator in a game.

    Raises:
        ValueError: in one line, if there are none; it names the command that finds them. Or if the
            estimator has no settings to search, the file that has them is damaged, or the estimator
            does not accept them.
    """
    check_searchable(cls)
    found = tuned_settings(cls, game)
    name, system = ESTIMATORS.spec_of(cls), type(game.source.system)
    if found is None:
        setup = "" if game.name.setup == "benchmark" else f" --setup {game.name.setup}"
        raise ValueError(
            f"no tuned settings of {name} are stored with {system.__name__} for setup "
            f"{game.name.setup!r}; they are found by: pinnobs tune {name} --system "
            f"{SYSTEMS.spec_of(system)}{setup} --store"
        )
    try:
        cls.for_setup(game.source.system, game.source.setup, **found)
    except ValueError as error:
        raise ValueError(f"{path_of(system)}: settings of {name}: {error}") from None
    return found


def is_tuned(cls: type[BaseEstimator], options: Mapping[str, Any], game: AnyGame) -> bool:
    """Return whether an estimator has the settings stored with the system of a game, and no others
    that are not the defaults of its class.

    Args:
        cls: the class of the estimator.
        options: its settings; those left out are the defaults.
        game: what is played.
    """
    changed = changed_options(cls, options)
    if not changed or cls.needs_training or cls.trains_on_record:
        return False
    stored = tuned_settings(cls, game)
    return stored is not None and changed_options(cls, stored) == changed


def changed_options(cls: type[BaseEstimator], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return those of an estimator's settings that are not the defaults of its class, in JSON's
    types."""
    found = {}
    defaults = {field.name: field for field in cls.setting_fields()}
    for name, given in options.items():
        default: Any = MISSING
        if name in defaults:
            field = defaults[name]
            default = field.default
            if default is MISSING and field.default_factory is not MISSING:
                default = field.default_factory()
        value = canonical(given)
        if default is MISSING or canonical(default) != value:
            found[name] = value
    return found
