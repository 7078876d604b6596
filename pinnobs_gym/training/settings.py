"""Settings of trainers: the shared ones, and functions that check and change settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any, ClassVar, Self, TypeVar

from pinnobs_gym.estimation.hints import as_tuple, check_settings, field_hints, fits
from pinnobs_gym.registry import did_you_mean

SEEDS = 2**32
"""Number of seeds of a training, from 0 on: those that every library of random numbers takes."""


@dataclass(frozen=True)
class TrainingConfig:
    """Base class of the settings of a trainer.

    A trainer's Config derives from it. Each field has a type annotation and a default; a preset is
    a function that returns a complete Config, see `Trainer.presets`. Values are checked against the
    annotations; a Config that checks more in ``__post_init__`` calls `check_shared` first.
    """

    may_change: ClassVar[tuple[str, ...]] = ()
    """Settings that may differ when a training is resumed, besides `ALWAYS_MAY_CHANGE`."""

    seed: int = 0
    """Seed of all random numbers of a training, from 0 to 2³² − 1."""
    budget: float | None = None
    """CPU seconds after which training stops, including those before a resumption."""
    checkpoint_every: int = 100
    """Iterations between checkpoints."""
    log_every: int = 20
    """Iterations between points of the logged curves."""

    @property
    def recipe(self) -> str:
        """The recipe in a few words, which names of estimators in tables show; empty if the trainer
        has one recipe only."""
        return ""

    @property
    def knows(self) -> tuple[str, ...]:
        """The information that the training uses in addition to that of its estimators."""
        return ()

    @property
    def records(self) -> int:
        """Number of recorded episodes to train on; 0 if the trainer plays episodes itself."""
        return 1

    def for_records(self, number: int) -> Self:
        """Return the settings for a number of records, such as those of sensor logs.

        Raises:
            ValueError: in one line, if the trainer learns from another number.
        """
        if number != self.records:
            raise ValueError(
                f"{number} logs are given; expected {self.records}, which this trainer learns from"
            )
        return self

    def __post_init__(self) -> None:
        self.check_shared()

    def check_shared(self) -> None:
        """Check the types of all settings, and the values of those that all trainers share.

        Raises:
            ValueError: in one line, naming the setting, its value and what was expected.
        """
        # Of a number that is out of range, the range is told rather than the type.
        expected = f"a whole number from 0 to {SEEDS - 1}"
        check_setting(
            self, "seed", expected, lambda v: not isinstance(v, Real) or v in range(SEEDS)
        )
        expected = "None or positive seconds"
        check_setting(self, "budget", expected, lambda v: not isinstance(v, Real) or float(v) > 0)
        check_settings(self, fields(self))
        check_whole(self, ("checkpoint_every", "log_every"))


ALWAYS_MAY_CHANGE = ("budget", "checkpoint_every", "log_every")
"""Settings of every trainer that may differ when a training is resumed; they affect only when it
ends and what is saved and logged."""

ConfigT = TypeVar("ConfigT")


def changed(config: ConfigT, changes: Mapping[str, Any]) -> ConfigT:
    """Return a copy of a config, or of any dataclass of settings, with some fields replaced.

    Raises:
        ValueError: in one line, if a setting is unknown, with the names of the known ones, or if a
            value is not allowed.
    """
    settings: Any = config
    known = sorted(f.name for f in fields(settings) if f.init)
    for name in changes:
        if name not in known:
            guess = did_you_mean(name, known)
            raise ValueError(f"setting {name!r}; expected one of {', '.join(known)}{guess}")
    hints = field_hints(type(settings))
    values = dict(changes)
    for name, value in changes.items():
        hint = hints.get(name, Any)
        if fits(value, hint):  # an error shows the value as it was given
            values[name] = as_tuple(value, hint)
    return replace(settings, **values)


def check_setting(config: object, name: str, expected: str, allowed: Callable[[Any], bool]) -> None:
    """Check one setting of a config.

    Args:
        config: the settings.
        name: name of the setting.
        expected: description of the allowed values, for the error message.
        allowed: returns whether a value is allowed.

    Raises:
        ValueError: in one line, naming the setting, its value and what was expected.
    """
    value = getattr(config, name)
    try:
        good = allowed(value)
    except (TypeError, ValueError, OverflowError):
        good = False
    if not good:
        raise ValueError(f"{name}={value!r}; expected {expected}")


def check_whole(config: object, names: Iterable[str], least: int = 1) -> None:
    """Check that settings are whole numbers of at least ``least``.

    Raises:
        ValueError: as `check_setting` does.
    """
    for name in names:
        expected = f"a whole number of at least {least}"
        check_setting(config, name, expected, lambda v: _is_whole(v) and v >= least)


def _is_whole(value: Any) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)
