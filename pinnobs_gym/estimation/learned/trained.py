"""Trained objects, which trainers return and estimators load: weights and training metadata."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self, TypeAlias, get_args, get_type_hints

import numpy as np

from pinnobs_gym.estimation.hints import as_tuple, check_field, field_hints
from pinnobs_gym.estimation.learned.trained_file import (
    check_same,
    identity,
    read,
    with_arrays,
    with_tensors,
    write,
)
from pinnobs_gym.registry import trainer_name
from pinnobs_gym.simulation.system import System

Ending: TypeAlias = Literal["running", "finished", "budget", "interrupted"]
"""How a training ended: by itself, by its budget of CPU seconds, or by Ctrl-C; or not yet."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trained(ABC):
    """Base class of trained objects: training metadata, saving and loading.

    A subclass adds fields, all of which are saved: arrays, plain values, tuples of these, or
    dataclasses of them.
    """

    trainer: str
    """Name of the trainer."""
    system: str
    """Class name of the system."""
    parameters: Mapping[str, Any]
    """The system's physical parameters, as JSON values."""
    noise_std: tuple[float, ...]
    """Standard deviations of the output noise given to the trainer, in output units."""
    condition: str
    """Name of the condition of the training episodes."""
    config: Mapping[str, Any]
    """The trainer's settings, as JSON values."""
    seed: int
    """Seed of the initial weights; it differs from the config's if training was restarted."""
    loss: float
    """The least loss; see the trainer."""
    iterations: int
    """Number of iterations of the training."""
    seconds: float
    """CPU time of the training in s."""
    ending: Ending
    """How the training ended."""

    @abstractmethod
    def check_fits(self, path: str | Path, system: System) -> None:
        """Check that the sizes of the weights fit a system.

        Raises:
            ValueError: in one line, with the file, the value found and the value expected.
        """

    @property
    def notes(self) -> Mapping[str, Any]:
        """Further training metadata for rows of results."""
        return {}

    def save(self, path: str | Path) -> None:
        """Write the object to a file of tensors and plain values, without code.

        Raises:
            ValueError: in one line, if the file cannot be written.
        """
        write(path, {"class": type(self).__name__, "fields": with_tensors(content_of(self))})

    @classmethod
    def load(cls, path: str | Path, system: System, trainer: str | None = None) -> Self:
        """Read a file that `save` wrote.

        Args:
            path: path of the file.
            system: the system it has to be trained for.
            trainer: name of the trainer it has to come from; any if None.

        Raises:
            ValueError: in one line, if the file does not exist, is damaged or of another kind, or
                belongs to another system, other parameters or sizes, or another trainer.
        """
        saved = with_arrays(read(path))
        try:
            if saved.get("class") != cls.__name__:
                raise TypeError("another kind of file")
            trained = from_content(cls, saved["fields"])
            found = {"system": trained.system, "parameters": trained.parameters}
            check_same(path, found, {name: identity(system)[name] for name in found})
            try:
                trained.check_fits(path, system)
            except ValueError as error:
                raise error if str(path) in str(error) else TypeError(error) from None
        except (LookupError, TypeError, AttributeError, RuntimeError, ArithmeticError) as error:
            reason = str(error).partition("\n")[0]
            raise ValueError(f"{path} is not a saved {cls.__name__}: {reason}") from None
        if trainer is not None:
            check_same(path, {"trainer": trained.trainer}, {"trainer": trainer})
        return trained


def content_of(value: Any) -> Any:
    """Convert a dataclass to a dict of its fields, recursively; return other values unchanged."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: content_of(getattr(value, f.name)) for f in fields(value)}
    return value


def from_content(kind: type, content: Mapping[str, Any]) -> Any:
    """Create an object of a dataclass from its `content_of`. A field that has a default may be
    missing.

    Raises:
        KeyError: if a field is missing.
        TypeError: in one line, if a value is not of its field's type, or is not allowed.
    """
    hints = field_hints(kind)
    values = {}
    for field in fields(kind):
        if field.name not in content and field.default is not MISSING:
            continue
        value, hint = content[field.name], hints.get(field.name, Any)
        within = (hint, *get_args(hint))  # also within an optional type
        kinds = [each for each in within if isinstance(each, type) and is_dataclass(each)]
        if kinds and value is not None:
            value = from_content(kinds[0], value)
        values[field.name] = as_tuple(value, hint)  # JSON has lists only
    try:
        for name, value in values.items():
            check_field(name, value, hints.get(name, Any))
        return kind(**values)
    except ValueError as error:
        raise TypeError(error) from None


class LearnedEstimator(ABC):
    """Base class of learned estimators, which hold, load and save a trained object.

    The annotation of the field ``trained`` names its class, a subclass of `Trained`.
    """

    needs_training: ClassVar[str | None]
    knows: ClassVar[tuple[str, ...]]
    trained: Any

    @classmethod
    def load(cls, path: str | Path, system: System) -> Self:
        """Load the estimator from a file; see `Trained.load`.

        If it uses the output noise, that given to its trainer is taken.
        """
        kind: type[Trained] = get_type_hints(cls)["trained"]
        trained = kind.load(path, system, trainer_name(cls))
        made: Any = cls
        noise_std = trained.noise_std if "noise" in cls.knows else None
        return made(system, noise_std, trained=trained)

    def unfit(self, t: np.ndarray) -> str:
        """Return why the estimator cannot be used at sample times t (num_samples,) in s of another
        record than that of its training; empty if it can, at any times unless overridden."""
        return ""

    def save(self, path: str | Path) -> None:
        """Write the trained object to a file; see `Trained.save`."""
        self.trained.save(path)

    @property
    def training(self) -> dict[str, Any]:
        """Training metadata for rows of results."""
        names = ("trainer", "condition", "seed", "loss", "iterations", "seconds", "ending")
        own = {name: getattr(self.trained, name) for name in (*names, "config")}
        return {**own, **self.trained.notes}
