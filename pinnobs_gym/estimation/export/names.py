"""Names of exported estimators, with which their types and functions begin."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import chain

from pinnobs_gym.estimation.export.pruning import bare

_IDENTIFIER = re.compile(r"[A-Za-z]\w*", re.ASCII)
_PLACE = re.compile(r"@\w+@")
_WORD = re.compile(r"[A-Za-z_]\w*", re.ASCII)
_OWN = ("", "_init", "_update", "_status")
"""What follows the name in the names of the files' types and functions."""


def check_name(name: str, texts: Iterable[str]) -> None:
    """Check that a name is one in C, and that neither the languages nor the code has it.

    Args:
        name: the name.
        texts: the code, with the places of the name.

    Raises:
        ValueError: in one line.
    """
    if not _IDENTIFIER.fullmatch(name):
        raise ValueError(f"name={name!r}; expected a name in C: letters, digits and underscores")
    code = (_WORD.findall(_PLACE.sub("", bare(text))) for text in texts)
    taken = _of_languages().union(*code)
    if found := next((name + end for end in _OWN if name + end in taken), None):
        raise ValueError(f"name={name!r}: {found} is taken by C or the code; expected another name")


def _of_languages() -> set[str]:
    """Return the keywords of C and C++, whose programs include the header, and the functions of the
    mathematics library."""
    from sympy.printing.c import known_functions_C99, reserved_words
    from sympy.printing.cxx import reserved

    functions = (each for each in known_functions_C99.values() if isinstance(each, str))
    return {*reserved_words, *chain.from_iterable(reserved.values()), *functions}
