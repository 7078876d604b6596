"""Settings of an estimator that are not the usual ones, which its name in tables shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from pinnobs_gym.envs.game import AnyGame
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.registry import trainer_class
from pinnobs_gym.scoring.provenance import canonical
from pinnobs_gym.scoring.tuned import changed_options, is_tuned
from pinnobs_gym.training.settings import ALWAYS_MAY_CHANGE

_ASIDE = ("seed", *ALWAYS_MAY_CHANGE)
"""Settings of trainers that names do not show, or show otherwise."""


def deviations(estimator: BaseEstimator, game: AnyGame) -> dict[str, Any]:
    """Return what differs between an estimator and the one that its name stands for in a game: its
    settings or those of its training that are not the defaults, a noise level or a model other than
    those of the game, and a condition that it was trained under. If its settings are those tuned
    for the game, its name says so (`pinnobs_gym.scoring.tuned`), and they are none of these."""
    cls, options = type(estimator), estimator.options
    if cls.needs_training or cls.trains_on_record:
        found = _of_training(estimator)
    else:
        found = {} if is_tuned(cls, options, game) else changed_options(cls, options)
    if "noise" in estimator.knows:
        system, setup = game.source.system, game.source.setup
        known = system.noise(estimator.noise_std, estimator.process_noise)
        played = system.noise(setup.noise_std, setup.process_noise)
        for name, own, real in (
            ("noise_std", known.output, played.output),
            ("process_noise", known.process, played.process),
        ):
            if own.shape != real.shape or not np.allclose(own, real, rtol=1e-9, atol=0.0):
                found[name] = canonical(_level(own))
    own, model = (canonical(each.parameters) for each in (estimator.system, game.source.system))
    found |= {name: value for name, value in own.items() if model.get(name) != value}
    trained_under = estimator.training.get("condition", "nominal")
    if trained_under not in ("nominal", game.name.condition):
        found["trained_under"] = trained_under
    return found


def _level(root: np.ndarray) -> np.ndarray | float:
    """Return a level of noise as a setup gives it: one number, one per component, or a matrix."""
    std = np.sqrt((root * root).sum(axis=1))
    if root.shape != (len(std), len(std)) or not np.array_equal(root, np.diag(std)):
        return root
    return std if len(std) > 1 else float(std[0])


def _of_training(estimator: BaseEstimator) -> dict[str, Any]:
    """Return the settings of the training that are not those of the estimator's own recipe; a
    preset's name stands for its settings, unless the name of the estimator's recipe says it."""
    cls, config = type(estimator), canonical(estimator.training.get("config", {}))
    try:
        trainer, usual = trainer_class(cls), cls.trainer_config({})
    except ValueError:  # its trainer is not known here, so that no settings are the usual ones
        return {}
    nearest, differences = _nearest(usual, trainer.presets, config)
    found: dict[str, Any] = {}
    if nearest and trainer.presets[nearest]().recipe == usual.recipe:
        found["preset"] = nearest
    return found | differences


def preset_of(cls: type[BaseEstimator], config: Mapping[str, Any]) -> str:
    """Return the preset that is nearest to the settings of a training, as they are in rows; empty
    if that is the estimator's own, or if it is not trained.

    Raises:
        ValueError: in one line, if its trainer is not known here.
    """
    if not (cls.needs_training or cls.trains_on_record):
        return ""
    return _nearest(cls.trainer_config({}), trainer_class(cls).presets, config)[0]


def _nearest(
    usual: Any, presets: Mapping[str, Callable[[], Any]], config: Mapping[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return the preset that is nearest to some settings, and what differs from it; the name is
    empty for the estimator's own recipe, which counts first if several are as near."""
    makers = {"": lambda: usual, **presets}
    differences = {name: _differences(config, asdict(make())) for name, make in makers.items()}
    nearest = min(differences, key=lambda name: len(differences[name]))
    return nearest, differences[nearest]


def _differences(config: Mapping[str, Any], preset: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a config that are not those of a preset."""
    usual = canonical(preset)
    return {
        name: value
        for name, value in config.items()
        if name not in _ASIDE and (name not in usual or usual[name] != value)
    }
