"""Numbers on the command line: in digits from 0 to 9, as in files."""

from __future__ import annotations

import math
import re

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from pinnobs_gym.logs.csv_lines import shown
from pinnobs_gym.logs.table import number

_DIGITS = 18
"""Largest number of digits of a whole number, which then fits in 64 bits."""

NUMBERS = ConstructorRegistry()
"""The rules by which tyro reads whole numbers and numbers; its own are those of Python, which also
takes underscores, digits of other scripts, and whole numbers of any size."""


@NUMBERS.primitive_rule
def _rule(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    parse = {int: _whole, float: finite_or_inf}.get(info.type)  # pyright: ignore
    if parse is None:
        return None
    kinds = (int,) if info.type is int else (int, float)
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT" if info.type is int else "FLOAT",
        instance_from_str=lambda texts: parse(texts[0]),
        is_instance=lambda value: isinstance(value, kinds) and not isinstance(value, bool),
        str_from_instance=lambda value: [str(value)],
    )


def _whole(text: str) -> int:
    if not re.fullmatch(rf"[+-]?[0-9]{{1,{_DIGITS}}}", text.strip()):
        raise ValueError(f"{shown(text)}; expected a whole number of at most {_DIGITS} digits")
    return int(text)


def finite_or_inf(text: str) -> float:
    """Return the number that a text is; ``inf`` is one, but 1e400 is too large.

    Raises:
        ValueError: in one line that has the text, if it is none.
    """
    try:
        value = number(text.strip())
    except ValueError:
        raise ValueError(f"{shown(text)}; expected a number") from None
    if math.isinf(value) and "inf" not in text.lower():
        raise ValueError(f"{shown(text)}; expected a number below 1e308")
    return value
