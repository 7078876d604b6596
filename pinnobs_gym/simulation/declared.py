"""Checks of what the class of a system declares, before anything is computed with it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Mapping
from dataclasses import MISSING, fields
from difflib import get_close_matches
from functools import cache, cached_property
from itertools import chain
from typing import Any

import numpy as np

from pinnobs_gym.simulation.bounds import beyond, box
from pinnobs_gym.simulation.residual import check_periods
from pinnobs_gym.simulation.start_law import Box, Points
from pinnobs_gym.simulation.system import Setup, System, initial_states, vector
from pinnobs_gym.simulation.values import is_number, shortly

_NAMES = ("state_names", "output_names", "input_names", "uncertain")
"""Attributes that are several names."""
_NO_NAME = ',;"'
"""Characters that the names of columns cannot have."""
_CALLS = {
    "f": "t, x, u",
    "h": "t, x, u",
    "flow": "t0, t1, x, u",
    "input": "t",
    "draw_input": "rng, times",
    "breakpoints": "",
}
"""Methods whose arguments are counted."""
_NEAR = 0.85
"""Likeness from which on an attribute's name counts as a misspelt one
(`difflib.SequenceMatcher.ratio`)."""
_STARTS = 20
"""Number of initial states that are drawn to compare them with the bounds."""


def check_declared(cls: type[System]) -> None:
    """Check the attributes of a system's class, each for itself and for the number of states and
    outputs.

    Raises:
        TypeError: in one line, naming the class, the attribute, its value and what was expected.
    """
    try:
        check_fields(cls)
        _check_names(cls)
        _check_methods(cls)
        _check_numbers(cls)
        _check_others(cls)
        _check_motion(cls)
        _check_unknown(cls)
    except ValueError as error:
        raise TypeError(f"system {cls.__name__}: {error}") from None


@cache
def check_fields(cls: type) -> None:
    """Check that no class gives a dataclass's field another default without being one itself, or
    without an annotation: every instance would have the default of the field.

    Raises:
        ValueError: in one line, naming the attribute.
    """
    for field in fields(cls):
        value = inspect.getattr_static(cls, field.name, MISSING)
        if value is MISSING or value is field.default or hasattr(value, "__get__"):
            continue
        kind = field.type if isinstance(field.type, str) else getattr(field.type, "__name__", "...")
        raise ValueError(
            f"{field.name} = {shortly(value)} has no effect, because {field.name} is a field; "
            f"expected @dataclass(frozen=True) on the class and {field.name}: {kind} = "
            f"{shortly(value)}"
        )


def _own(cls: type[System], name: str) -> Any:
    """Return an attribute; None if the class computes it for each of its instances."""
    value = getattr(cls, name, None)
    return None if isinstance(value, property | cached_property) else value


def _check_names(cls: type[System]) -> None:
    for name in _NAMES:
        names = _own(cls, name)
        if names is None and (name == "uncertain" or getattr(cls, name, None) is not None):
            continue
        if not isinstance(names, tuple | list) or not all(
            isinstance(each, str) and each for each in names
        ):
            few = (names,) if isinstance(names, str) else ("a", "b")
            raise ValueError(f"{name}={names!r}; expected a tuple of names, such as {few!r}")
        for each in names:
            if not each.isprintable() or each != each.strip() or set(each) & set(_NO_NAME):
                raise ValueError(
                    f"{name}={names!r}; expected names for the header of a table, without "
                    "commas, semicolons, quotes, line breaks, and blanks at their ends"
                )
        twice = [each for each in names if list(names).count(each) > 1]
        if twice:
            raise ValueError(f"{name}={names!r}; expected {twice[0]!r} once")
        if not names and name in ("state_names", "output_names"):
            raise ValueError(f"{name}={names!r}; expected at least one name")


def _check_methods(cls: type[System]) -> None:
    for name, value in vars(System).items():
        own = getattr(cls, name)
        if inspect.isfunction(value) and not callable(own):
            raise ValueError(f"{name}={own!r}; expected a method")
    for name, expected in _CALLS.items():
        taken = list(inspect.signature(getattr(cls, name)).parameters)
        wanted = ["self", *filter(None, expected.split(", "))]
        if len(taken) != len(wanted):
            raise ValueError(f"{name}({', '.join(taken)}); expected {name}({', '.join(wanted)})")


def _check_numbers(cls: type[System]) -> None:
    nx, ny = (_size(cls, name) for name in ("state_names", "output_names"))
    for name in ("scale", "state_bound"):
        values = _own(cls, name)
        if values is None:
            continue
        several = isinstance(values, tuple | list | np.ndarray)
        if not several or not all(is_number(v) and 0 < v < math.inf for v in values):
            raise ValueError(f"{name}={values!r}; expected a positive number for each state")
        if nx is not None and len(values) != nx:
            raise ValueError(f"{name} has {len(values)} number(s); expected {nx}")
    for name, size in (("state_period", nx), ("output_period", ny)):
        if size is not None:
            check_periods(_own(cls, name), size, name)
    if nx is not None:
        _check_bounds(cls, nx)
    step = _own(cls, "model_step")
    if step is not None and not (is_number(step) and 0 < step < math.inf):
        raise ValueError(f"model_step={step!r}; expected None or a positive number of seconds")


def _check_bounds(cls: type[System], nx: int) -> None:
    """Check the bounds for themselves, and that no state has both bounds and a period."""
    bounds = box(_own(cls, "state_low"), _own(cls, "state_high"), nx)
    for i, period in enumerate(_own(cls, "state_period") or ()):
        if period is not None and bounds is not None and bounds.bounded[i]:
            raise ValueError(
                f"state_period={period:g} and bounds {bounds.low[i]:g} to {bounds.high[i]:g} of "
                f"state {i + 1}; expected one of them, as a state that repeats goes on beyond them"
            )


def check_starts(cls: type[System]) -> None:
    """Check that the initial states and the priors of all setups are within the bounds of the
    states. Of a Gaussian law, states outside are drawn anew. Where `System.admissible` is
    overridden, some of the states that it admits are drawn.

    Raises:
        TypeError: in one line, naming the class, the setup, the state and its bound.
    """
    for name in cls.setups:
        system, setup = cls.configured(name)
        if system.state_box is None:
            continue
        law = setup.start(system.nx)
        if isinstance(law, Box | Points) and cls.admissible is System.admissible:
            x0 = np.stack(law.corners)
        else:
            x0 = initial_states(system, setup, _STARTS)
        given = [("an initial state", x0)]
        for what, prior in (("the prior's mean", setup), ("the poor prior's", setup.poor_prior)):
            if prior is not None and prior.xhat0 is not None:
                given.append((what, vector(prior.xhat0, system.nx, "xhat0")))
        for what, x in given:
            if (found := beyond(system, x)) is not None:
                raise TypeError(
                    f"system {cls.__name__}, setup {name!r}: {found}, in {what}; expected it "
                    "within the bounds"
                )


def _size(cls: type[System], name: str) -> int | None:
    """Return the number of names; None if they are not those of the class."""
    names = _own(cls, name)
    return None if names is None else len(names)


def _check_motion(cls: type[System]) -> None:
    """Check that what the class says of its motion agrees."""
    hold, own = _own(cls, "input_hold"), cls.flow is not System.flow
    if hold not in ("previous", "linear", None):
        raise ValueError(f"input_hold={hold!r}; expected 'previous' or 'linear'")
    if own and hold == "linear":
        raise ValueError(
            "input_hold='linear', and a flow of its own, whose input is held; expected 'previous'"
        )
    discrete = bool(_own(cls, "discrete"))
    if discrete and (own or _own(cls, "stiff")):
        other = "its own flow" if own else "stiff=True"
        raise ValueError(f"discrete=True, a map, and {other}; expected one of them")


def _check_unknown(cls: type[System]) -> None:
    """Check that no attribute has a name that is nearly one of `System`, and that units have names
    of the class. Parameters, methods and properties may have any name."""
    parameters = {f.name for f in fields(cls)}
    known = {n for n in (*vars(System), *System.__annotations__) if not n.startswith("_")}
    for base in cls.__mro__[: cls.__mro__.index(System)]:
        for name, value in vars(base).items():
            own = name.startswith("_") or name in known | parameters
            if own or callable(value) or hasattr(value, "__get__"):
                continue
            near = get_close_matches(name, known, 1, _NEAR)
            if near:
                raise ValueError(f"unknown attribute {name}; did you mean {near[0]}?")
    names = [_own(cls, name) for name in ("state_names", "output_names", "input_names")]
    if "units" not in vars(cls) or None in names or isinstance(vars(cls)["units"], property):
        return
    everything = [*chain(*names), *(f.name for f in fields(cls) if not f.kw_only)]
    for name in cls.units:
        if name not in everything:
            near = get_close_matches(str(name), everything, 1) or [", ".join(everything)]
            raise ValueError(f"units of an unknown name {name!r}; did you mean {near[0]}?")


def _check_others(cls: type[System]) -> None:
    for name in ("discrete", "stiff"):
        value = _own(cls, name)
        if value is not None and not isinstance(value, bool):
            raise ValueError(f"{name}={value!r}; expected True or False")
    if not isinstance(_own(cls, "version") or 0, int):
        raise ValueError(f"version={cls.version!r}; expected a whole number")
    if not isinstance(_own(cls, "units") or {}, Mapping):
        raise ValueError(f"units={cls.units!r}; expected a mapping from names to units")
    setups = _own(cls, "setups")
    if setups is None:
        return
    if not isinstance(setups, Mapping) or not all(isinstance(s, Setup) for s in setups.values()):
        raise ValueError(
            f"setups is a {type(setups).__name__}; expected a mapping from names to values of Setup"
        )
    if "benchmark" not in setups:
        raise ValueError(f"setups named {', '.join(setups)}; expected one named 'benchmark'")
