"""The functions of C code that others need; the rest is left out of exported files."""

from __future__ import annotations

import re
from dataclasses import dataclass

_COMMENT = r"(?:/\*(?:[^*]|\*(?!/))*\*/\n)?"
_FUNCTION = re.compile(
    rf"^{_COMMENT}(?:(?:static|SEPARATE)\b[^;{{}}=]*?\b(\w+)\([^;{{}}]*\)\s*"
    rf"(?:\{{[^\n]*\}}\n|\{{\n.*?^\}}\n?)|static const \w+ (\w+)\[\d+\] = \{{[^}}]*\}};\n?)",
    re.M | re.S,
)
_NAME = re.compile(r"\b[A-Za-z_]\w*\b")


@dataclass(frozen=True)
class _Function:
    name: str
    start: int
    end: int
    uses: frozenset[str]


def needed_code(text: str) -> str:
    """Return code without the static functions that its other parts do not use, directly or through
    others, and without the comments before these."""
    functions = [
        _Function(f[1] or f[2], f.start(), f.end(), frozenset(_NAME.findall(bare(f[0]))))
        for f in _FUNCTION.finditer(text)
    ]
    rest, last = [], 0
    for function in functions:
        rest.append(text[last : function.start])
        last = function.end
    rest.append(text[last:])
    used = set(_NAME.findall(bare("".join(rest))))
    known = {function.name: function for function in functions}
    waiting = [name for name in used if name in known]
    while waiting:
        for name in known[waiting.pop()].uses & known.keys() - used:
            used.add(name)
            waiting.append(name)
    kept, last = [], 0
    for function in functions:
        kept.append(text[last : function.start])
        if function.name in used:
            kept.append(text[function.start : function.end])
        last = function.end
    kept.append(text[last:])
    return re.sub(r"\n{3,}", "\n\n", "".join(kept))


def bare(text: str) -> str:
    """Return code without comments."""
    return re.sub(r"/\*.*?\*/", " ", text, flags=re.S)


_STRUCT = re.compile(r"^struct plan \{\n(.*?)^\};\n", re.M | re.S)
_FIELD = re.compile(r"\*?(\w+)(?=[,;])")


def needed_fields(text: str) -> str:
    """Return code whose ``struct plan`` has the fields that are used alone, of which each has a
    line of its own in the initialisation."""
    found = _STRUCT.search(text)
    assert found is not None
    used = set(re.findall(r"(?:->|plan\.)(\w+)", text))
    kept = [line for line in found[1].splitlines() if set(_FIELD.findall(bare(line))) & used]
    unused = set(_FIELD.findall(bare(found[1]))) - used
    kept_names = {name for line in kept for name in _FIELD.findall(bare(line))}
    text = text.replace(found[1], "".join(f"{line}\n" for line in kept), 1)
    for name in unused - kept_names:
        text = re.sub(rf"^    \.{name} = [^\n]*\n", "", text, flags=re.M)
    return text
