"""Parsing of command lines: options, and ``name=value`` settings of an estimator."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, ClassVar, TypeVar, get_args, get_origin, get_type_hints

import tyro
from rich.text import Text

from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.registry import TRAINERS

T = TypeVar("T")


def parse(kind: type[T], command: str, arguments: Sequence[str], **options: Any) -> T:
    """Parse a command's options from its arguments; ``options`` are passed to `tyro.cli`.

    Raises:
        ValueError: in one line, if the arguments are invalid.
    """
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return tyro.cli(kind, prog=f"pinnobs {command}", args=arguments, **options)
    except SystemExit as end:
        if not end.code:  # help was printed
            raise
    message = _first_of(errors.getvalue()).removeprefix("Error parsing config: ")
    raise ValueError(f"{message}; see pinnobs {command} --help") from None


def _first_of(box: str) -> str:
    """Return the text of a framed message between its title and its next rule, in one line."""
    parts: list[list[str]] = [[]]
    for line in Text.from_ansi(box).plain.splitlines():
        text = line.strip("│| ")
        if "──" in text or "---" in text:  # a rule, or the title within the frame
            parts.append([])
        else:
            parts[-1].append(text)
    said = [" ".join(" ".join(part).split()) for part in parts[1:]]
    return next(filter(None, said), "the arguments are wrong").removesuffix(".")


def settings_of(cls: type[BaseEstimator], settings: Sequence[str]) -> dict[str, Any]:
    """Parse ``name=value`` settings of an estimator, or of the trainer that it runs on the record.

    Raises:
        ValueError: in one line, naming the invalid setting and the known names.
    """
    base = {f.name for f in fields(BaseEstimator)}
    own = {f.name: f for f in fields(cls) if f.name not in base and f.repr}
    trained_by = cls.trains_on_record
    hints = {n: h for n, h in get_type_hints(cls).items() if n in own}
    trainer: Any = None if trained_by is None else TRAINERS.resolve(trained_by)
    recipe: dict[str, Any] = {}
    nested: dict[str, Any] = {}
    if trainer is not None:  # its settings are those of its recipe, the field ``config``
        hints.pop("config")
        kinds = get_type_hints(type(trainer.configured({})))
        nested = {"preset": str} | {n: h for n, h in kinds.items() if get_origin(h) is not ClassVar}
    values: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if equals and name in hints:
            values[name] = _parsed(setting, text, hints[name])
        elif equals and name in nested:
            recipe[name] = _parsed(setting, text, nested[name])
        else:
            listed = ", ".join(sorted([*hints, *nested])) or "none"
            raise ValueError(f"setting {setting!r}; expected name=value with a name of: {listed}")
    if trainer is not None and recipe:
        values["config"] = trainer.configured(recipe)
    return values


def _parsed(setting: str, text: str, hint: Any) -> Any:
    """Convert the text to the type of the field: an int, a float or a string."""
    kinds = get_args(hint) or (hint,)
    for kind in (int, float):
        if kind in kinds:
            try:
                return kind(text)
            except ValueError:
                expected = "a whole number" if kind is int else "a number"
                raise ValueError(f"setting {setting!r}; expected {expected}") from None
    return text
