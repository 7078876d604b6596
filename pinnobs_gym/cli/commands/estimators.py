"""`estimators [NAME]`: list the estimators, or print one with its settings."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Sequence
from dataclasses import MISSING, Field, dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

import tyro

from pinnobs_gym.cli.console import console, print_next, print_table
from pinnobs_gym.cli.options import parse
from pinnobs_gym.cli.system_page import field_docs
from pinnobs_gym.estimation.estimator import BaseEstimator
from pinnobs_gym.estimation.hints import field_hints
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.leaderboard.grid import Column, Grid


@dataclass(frozen=True)
class Estimators:
    """List the estimators, or print the description of one."""

    name: Annotated[str | None, tyro.conf.Positional] = None
    """Name or module:Class of an estimator."""

    def run(self) -> int:
        """Print the list or the description."""
        if self.name is None:
            print_table([[listing()]], "pinnobs estimators NAME says more")
            print_next("estimators", "ekf")
            return 0
        cls = ESTIMATORS.resolve(self.name)
        console.print(_described(cls), markup=False)
        console.print(f"\ntrack: {cls.track}; knows: {', '.join(cls.knows)}", highlight=False)
        trainer = cls.needs_training or cls.trains_on_record
        if trainer is not None:
            when = "beforehand" if cls.needs_training else "on each record"
            console.print(
                f"trained {when}, with the settings of pinnobs train {trainer} --help",
                highlight=False,
            )
        found = settings(cls)
        console.print("settings, each given by --set name=value:" if found else "no settings")
        for name, default, meaning in found:
            console.print(f"  {name}={default}", highlight=False, soft_wrap=True)
            for line in textwrap.wrap(meaning, console.width - 4):
                console.print(f"    {line}", highlight=False)
        if cls.needs_training is None:
            few = ["--episodes", 2] if cls.trains_on_record else []  # each takes a training
            print_next("evaluate", "--system", "ReverseDuffing", "--estimator", self.name, *few)
        else:
            print_next("train", trainer, "--system", "ReverseDuffing")
        return 0


def listing() -> Grid:
    """Return the table of estimators. In a terminal each has lines of its own, since what it is
    takes a whole one."""
    names = ("name", "track", "knows", "what it is")
    columns = tuple(Column(name, numeric=False) for name in names)
    lines = []
    for name, cls in ESTIMATORS.classes().items():
        first = _described(cls).partition("\n\n")[0].replace("\n", " ")
        lines.append((name, cls.track, ", ".join(cls.knows), first))
    return Grid("", columns, tuple(lines))


def _described(cls: type[BaseEstimator]) -> str:
    """Return the docstring of an estimator; a dataclass without one has its signature for it."""
    text = inspect.getdoc(cls) or ""
    return "(no docstring)" if not text or text.startswith(f"{cls.__name__}(") else text


def settings(cls: type[BaseEstimator]) -> list[tuple[str, str, str]]:
    """Return the name, the default and the meaning of each setting of an estimator."""
    docs, hints = field_docs(cls), field_hints(cls)
    found = []
    for each in cls.setting_fields():
        if not each.init or (cls.trains_on_record and each.name == "config"):
            continue
        meaning = " ".join(docs.get(each.name, "").split())
        words = (
            get_args(hints.get(each.name)) if get_origin(hints.get(each.name)) is Literal else ()
        )
        choices = f" One of {', '.join(map(str, words))}." if words else ""
        found.append((each.name, _default(each), meaning + choices))
    return found


def _default(field: Field[Any]) -> str:
    if field.default is not MISSING:
        return str(field.default)
    return "none" if field.default_factory is MISSING else str(field.default_factory())


def run(arguments: Sequence[str]) -> int:
    """Run the command and return its exit status."""
    return parse(Estimators, "estimators", arguments).run()
