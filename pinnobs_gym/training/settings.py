"""Settings of trainings: what all trainers share, how one is checked, and how some are changed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar, TypeVar


@dataclass(frozen=True)
class TrainingConfig:
    """What the settings of all trainers share.

    A trainer's own Config derives from it. Each field has a real type and a real default; a preset
    is a function that returns a whole Config, see `Trainer.presets`.
    """

    may_change: ClassVar[tuple[str, ...]] = ()
    """Settings that may differ when a training is resumed, beside `ALWAYS_MAY_CHANGE`."""

    seed: int = 0
    """What all that chance decides in a training is drawn from."""
    budget: float | None = None
    """CPU seconds after which training stops, those before a resumption included."""
    checkpoint_every: int = 100
    """Iterations from one checkpoint to the next."""
    log_every: int = 20
    """Iterations from one point of the logged curves to the next."""

    @property
    def records(self) -> int:
        """How many episodes are learned from; 0 if the trainer plays its own."""
        return 1

    def check_shared(self) -> None:
        """Check the settings of this class.

        Raises:
            ValueError: in one line, naming the setting, its value and what was expected.
        """
        check_whole(self, ("checkpoint_every", "log_every"))
        check_whole(self, ("seed",), least=0)
        check_setting(self, "budget", "None or positive seconds", lambda v: v is None or v > 0)


ALWAYS_MAY_CHANGE = ("budget", "checkpoint_every", "log_every")
"""Settings of every trainer that may differ when a training is resumed: they decide nothing but
when it ends and what is kept of it."""

ConfigT = TypeVar("ConfigT")


def changed(config: ConfigT, changes: Mapping[str, Any]) -> ConfigT:
    """A config, or any dataclass of settings, with some of its fields replaced.

    Raises:
        ValueError: in one line, if there is no such setting, naming those that there are, or if a
            value is not allowed.
    """
    settings: Any = config
    known = sorted(f.name for f in fields(settings) if f.init)
    for name in changes:
        if name not in known:
            raise ValueError(f"setting {name!r}; expected one of {', '.join(known)}")
    return replace(settings, **changes)


def check_setting(config: object, name: str, expected: str, allowed: Callable[[Any], bool]) -> None:
    """Check one setting.

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
    """Check settings that are whole numbers.

    Raises:
        ValueError: as `check_setting` does.
    """
    for name in names:
        expected = f"a whole number of at least {least}"
        check_setting(config, name, expected, lambda v: v == int(v) and v >= least)


def check_choice(config: object, name: str, known: Iterable[str]) -> None:
    """Check a setting that is one of some words.

    Raises:
        ValueError: as `check_setting` does.
    """
    *others, last = words = tuple(known)
    expected = f"{', '.join(others)} or {last}"
    check_setting(config, name, expected, lambda v: v in words)
