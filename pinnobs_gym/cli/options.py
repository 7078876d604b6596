"""Parsing of command lines: options, and ``name=value`` settings of an estimator."""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Collection, Sequence
from dataclasses import is_dataclass
from typing import Any, TypeVar, get_args, get_origin

import tyro
from rich.text import Text
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from pinnobs_gym.cli import HelpShown
from pinnobs_gym.cli.numbers import NUMBERS
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.hints import field_hints, fits, in_words
from pinnobs_gym.registry import did_you_mean
from pinnobs_gym.simulation.values import shortly

T = TypeVar("T")


def parse(kind: type[T], command: str, arguments: Sequence[str], **options: Any) -> T:
    """Parse a command's options from its arguments; ``options`` are passed to `tyro.cli`. Options
    of a field that is a dataclass have no prefix.

    The values of an option that takes several add up if it is repeated.

    Raises:
        ValueError: in one line, if the arguments are invalid, or if an option that takes one value
            is repeated.
    """
    lists = _lists(kind)
    for option, values in by_option(arguments):
        if option in lists and not values:
            raise ValueError(f"{option} without a value; expected one or several")
        if "" in values:  # as of a variable of the shell that is not set
            raise ValueError(f"{option or 'the first argument'} '' is empty; expected a value")
    arguments = _joined(arguments, lists)
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            options |= {"config": (tyro.conf.OmitArgPrefixes,), "registry": NUMBERS}
            return tyro.cli(kind, prog=f"pinnobs {command}", args=arguments, **options)
    except SystemExit as end:
        if not end.code:
            raise HelpShown(0) from None
    message = _first_of(errors.getvalue()).removeprefix("Error parsing config: ")
    known = {*_options(kind), "--help"}
    for option, _ in by_option(arguments):
        once = option.replace("--no-", "--", 1)
        if once.startswith("--") and once not in known:
            message = f"unknown option {option}{did_you_mean(option, known)}"
            break
    raise ValueError(f"{message}; see pinnobs {command} --help") from None


def by_option(arguments: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Split arguments at the options among them. Returns each option's name, empty for what comes
    before the first, with the arguments after it."""
    groups: list[tuple[str, list[str]]] = [("", [])]
    for argument in arguments:
        if re.match(r"--?[A-Za-z]", argument) and not re.fullmatch(r"-(inf|nan)", argument):
            option, equals, value = argument.partition("=")
            groups.append((option.replace("_", "-"), [value] * bool(equals)))
        else:
            groups[-1][1].append(argument)
    return groups


LOG_OPTIONS = ("--columns", "--also", "--noise-std", "--process-noise", "--xhat0", "--P0-std")
"""Options of sensor logs that commands have which otherwise simulate episodes."""


def check_apart(arguments: Sequence[str], simulated: Sequence[str], of_logs: Sequence[str]) -> None:
    """Check that options of simulated episodes and those of sensor logs, which are there if
    ``--log`` is, are not mixed.

    Args:
        arguments: the arguments of a command.
        simulated: its options of simulated episodes.
        of_logs: its options of logs beside ``--log``.

    Raises:
        ValueError: in one line that names the options.
    """
    given = dict(by_option(arguments))
    log = "--log" in given
    if log and not given["--log"]:
        raise ValueError("--log without a file; expected one or several")
    wrong = [option for option in (simulated if log else of_logs) if option in given]
    if wrong and log:
        raise ValueError(
            f"{', '.join(wrong)} and --log; {', '.join(simulated)} are of simulated episodes, "
            "which --log replaces"
        )
    if wrong:
        raise ValueError(f"{', '.join(wrong)} without --log; expected the log it belongs to")


def _joined(arguments: Sequence[str], lists: Collection[str]) -> list[str]:
    """Return the arguments with each option only once, with all its values if it is one of
    ``lists``.

    Raises:
        ValueError: in one line, if another option is repeated.
    """
    joined: dict[str, list[str]] = {}
    for option, values in by_option(arguments):
        once = option.replace("--no-", "--", 1)
        if option in lists and option in joined:
            joined[option] += values
        elif {once, once.replace("--", "--no-", 1)} & joined.keys():
            raise ValueError(f"{once} is given twice; expected once")
        else:
            joined[option] = values
    return [part for option, values in joined.items() for part in (option, *values)][1:]


def _lists(kind: Any) -> set[str]:
    """Return the options of a dataclass of options that take several values."""
    return {
        option
        for option, hint in _options(kind).items()
        if any(tuple in (each, get_origin(each)) for each in (hint, *get_args(hint)))
    }


def _options(kind: Any) -> dict[str, Any]:
    """Return the options of a dataclass of options, with the types of their values."""
    found: dict[str, Any] = {}
    made = get_origin(kind) or kind  # a generic class, or the class itself
    parameters = dict(zip(getattr(made, "__parameters__", ()), get_args(kind), strict=False))
    for name, hint in field_hints(made).items():
        within = parameters.get(hint, hint)
        found |= (
            _options(within) if is_dataclass(within) else {"--" + name.replace("_", "-"): within}
        )
    return found


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

    A value is parsed by the type of its field, with the rules of the other options; the items of a
    list are separated by commas or spaces.

    Raises:
        ValueError: in one line, naming the invalid setting and what was expected.
    """
    types = field_hints(cls)
    own = {f.name: types.get(f.name, Any) for f in cls.setting_fields() if f.init}
    trained_by = cls.trains_on_record
    nested: dict[str, Any] = {}
    if trained_by is not None:  # its settings are those of its recipe, the field ``config``
        own.pop("config")
        nested = {"preset": str, **field_hints(type(cls.trainer_config({})))}
    values: dict[str, Any] = {}
    given: dict[str, str] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        hint = {**nested, **own}.get(name)
        if not equals or hint is None:
            listed = ", ".join(sorted([*own, *nested])) or "none"
            raise ValueError(
                f"setting {shortly(setting)}; expected name=value with a name of: {listed}"
                f"{did_you_mean(name, [*own, *nested])}"
            )
        value = _parsed(name, text, hint)
        if name in values and value != values[name]:
            both = f"{shortly(given[name])} and {shortly(text)}"
            raise ValueError(f"setting {name!r} is given twice: {both}")
        values[name], given[name] = value, text
    if nested:
        recipe = {name: values.pop(name) for name in nested if name in values}
        values["config"] = cls.trainer_config(recipe)
    return values


def _parsed(name: str, text: str, hint: Any) -> Any:
    """Convert the text of a setting to the type of its field, with tyro's rules for one option."""
    with NUMBERS:
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(hint, set()))
    if isinstance(spec, UnsupportedTypeAnnotationError):
        raise ValueError(f"setting {name!r} can be given in Python only")
    parts = [text] if spec.nargs == 1 else [part for part in re.split(r"[\s,]+", text) if part]
    try:
        if set(parts) <= set(spec.choices or parts):
            value = spec.instance_from_str(parts)
            if fits(value, hint):
                return value
    except ValueError:
        pass
    raise ValueError(f"setting {shortly(name + '=' + text)}; expected {in_words(hint)}")
