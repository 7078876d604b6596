"""What trainers make and estimators load: weights, with the facts of their training."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeAlias, get_args, get_origin, get_type_hints

from pinnobs_gym.estimation.learned.trained_file import (
    check_same,
    identity,
    read,
    with_arrays,
    with_tensors,
    write,
)
from pinnobs_gym.simulation.system import System

Ending: TypeAlias = Literal["running", "finished", "budget", "interrupted"]
"""Why a training ended: by itself, its budget of CPU seconds, or Ctrl-C."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trained(ABC):
    """What all trained objects have in common: how their training went, and their file.

    A subclass adds fields of arrays, plain values, tuples of these, or further dataclasses of them;
    all are saved.
    """

    trainer: str
    """Name of the trainer."""
    system: str
    """Class name of the system."""
    parameters: Mapping[str, Any]
    """The system's physical parameters, as JSON holds them."""
    noise_std: tuple[float, ...]
    """Standard deviations of the output noise that training was given, in output units."""
    config: Mapping[str, Any]
    """The trainer's settings, as JSON holds them."""
    seed: int
    """What the weights were drawn from; not the config's if training had to begin again."""
    loss: float
    """The least loss; see the trainer."""
    iterations: int
    """Iterations made, of which the best is one."""
    seconds: float
    """CPU time in s that they took."""
    ending: Ending
    """Why the training ended."""

    @abstractmethod
    def check_fits(self, path: str | Path, system: System) -> None:
        """Check that the weights belong to a system of this size.

        Raises:
            ValueError: in one line, naming the file, what was found and expected.
        """

    @property
    def notes(self) -> Mapping[str, Any]:
        """What else rows say of the training."""
        return {}

    def save(self, path: str | Path) -> None:
        """Write it to one file of tensors and plain values. The file holds no code.

        Raises:
            ValueError: in one line, if the file cannot be written.
        """
        write(path, {"class": type(self).__name__, "fields": with_tensors(content_of(self))})

    @classmethod
    def load(cls, path: str | Path, system: System, trainer: str | None = None) -> Self:
        """Read what `save` wrote.

        Args:
            path: of the file.
            system: that it was trained for.
            trainer: that it was trained by; any if None.

        Raises:
            ValueError: in one line, if there is no such file, if it is something else or damaged,
                or if it belongs to another system, other parameters, sizes or another trainer.
        """
        saved = with_arrays(read(path))
        try:
            if saved.get("class") != cls.__name__:
                raise TypeError("another kind of file")
            trained = from_content(cls, saved["fields"])
            found = {"system": trained.system, "parameters": trained.parameters}
            check_same(path, found, {name: identity(system)[name] for name in found})
            trained.check_fits(path, system)
        except (KeyError, TypeError, IndexError, AttributeError, RuntimeError) as error:
            reason = str(error).partition("\n")[0]
            raise ValueError(f"{path} is not a saved {cls.__name__}: {reason}") from None
        if trainer is not None:
            check_same(path, {"trainer": trained.trainer}, {"trainer": trainer})
        return trained


def content_of(value: Any) -> Any:
    """A trained object, or any dataclass, as a dict of its fields, those within as well; anything
    else as it is."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: content_of(getattr(value, f.name)) for f in fields(value)}
    return value


def from_content(kind: type, content: Mapping[str, Any]) -> Any:
    """The object of a dataclass whose `content_of` this is."""
    hints = get_type_hints(kind)
    found = {}
    for field in fields(kind):
        value = content[field.name]
        within = (hints[field.name], *get_args(hints[field.name]))  # of an optional one as well
        kinds = [hint for hint in within if isinstance(hint, type) and is_dataclass(hint)]
        if kinds and value is not None:
            value = from_content(kinds[0], value)
        elif isinstance(value, list) and any(get_origin(hint) is tuple for hint in within):
            value = tuple(value)  # JSON has lists only
        found[field.name] = value
    return kind(**found)


class LearnedEstimator(ABC):
    """What estimators share that are trained beforehand: they hold what was trained, and load and
    save it. Their field ``trained`` is declared as the `Trained` that it holds."""

    needs_training: ClassVar[str | None]
    knows: ClassVar[tuple[str, ...]]
    trained: Any

    @classmethod
    def load(cls, path: str | Path, system: System) -> Self:
        """The estimator with what is in a file, told the noise of its training if it makes use of
        that; see `Trained.load`."""
        kind: type[Trained] = get_type_hints(cls)["trained"]
        trained = kind.load(path, system, cls.needs_training)
        made: Any = cls
        noise_std = trained.noise_std if "noise" in cls.knows else None
        return made(system, noise_std, trained=trained)

    def save(self, path: str | Path) -> None:
        """Write what was trained to a file; see `Trained.save`."""
        self.trained.save(path)

    @property
    def training(self) -> dict[str, Any]:
        """How it was trained, for rows."""
        names = ("trainer", "seed", "loss", "iterations", "seconds", "ending", "config")
        return {**{name: getattr(self.trained, name) for name in names}, **self.trained.notes}
