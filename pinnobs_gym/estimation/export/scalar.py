"""The code of compiled algorithms for a single episode, as plain C.

The templates of `pinnobs_gym.simulation.kernels` work on lanes, episodes side by side: an array of
lanes is (n, W), and one lane is an array of W numbers. Exported code has one episode, and numbers
in place of lanes. It is made from the same text by the rules of `scalar`, so that the operations
and their order are the same.
"""

from __future__ import annotations

import re

_NAME = re.compile(r"AT_WIDTH\((\w+)\)")
_ALIAS = re.compile(
    r"^#(?:define|undef) (?:lanes|interval|rk_step|steps|sample|memory)\b.*\n", re.M
)
_TYPE = re.compile(r"^typedef double lanes\[W\];\n#define EACH_LANE .*\n", re.M)
_DECLARED = re.compile(
    r"(?<![\w*(] )(?<![\w*(])\blanes ((?:\w+(?:\[[^\];]*\])*(?: = [^;,]*)?,?\s*)+);"
)
_SENTENCE = re.compile(r"(?<=[.:])\s+(?=[A-Z`])")
_OF_MANY = re.compile(
    r"\b(lanes?|NumPy|batch(es)?|rows?|episodes?|W|pinnobs_gym|step_code)\b", re.I
)
"""Words of comments on what code for a single episode does not have."""
_SCALAR = re.compile(r"^\w+$")
_LITERAL = re.compile(r"(?<![\w.])(?:\d+\.\d*(?:[eE][+-]?\d+)?|\d+[eE][+-]?\d+)(?![\w.])")


def scalar(text: str) -> str:
    """Return code on lanes as code for a single one, whose numbers are of the type ``real``."""
    parts = re.split(r"(/\*.*?\*/)", text, flags=re.S)  # code and comments in turn
    parts[1::2] = [_comment(part) for part in parts[1::2]]
    parts[::2] = [_code(part) for part in parts[::2]]
    lines = "".join(parts).splitlines()
    return re.sub(r"\n{3,}", "\n\n", "\n".join(line.rstrip() for line in lines) + "\n")


def _code(text: str) -> str:
    """Return code without comments for a single lane."""
    text = _TYPE.sub("", text)
    text = _NAME.sub(r"\1", text)
    text = _ALIAS.sub("", text)
    text = _DECLARED.sub(_declared, text)
    text = re.sub(r"\blanes\b", "real", text)
    text = re.sub(r"(?<!typedef )\bdouble\b", "real", text)
    text = text.replace("][l]", "]").replace("[l]", "[0]").replace("[W]", "[1]")
    return text.replace("EACH_LANE ", "")


def _comment(text: str) -> str:
    """Return a comment without the sentences on what this code does not have."""
    body = text[2:-2].strip()
    kept = [part for part in _SENTENCE.split(body) if not _OF_MANY.search(part)]
    return f"/* {' '.join(kept)} */" if kept else ""


def _declared(found: re.Match[str]) -> str:
    """Return a declaration, in which single lanes are arrays of one number."""
    parts = [part.strip() for part in re.split(r",(?![^\[]*\])", found[1])]
    return f"real {', '.join(p + '[1]' if _SCALAR.match(p) else p for p in parts)};"


def single(text: str) -> str:
    """Return code with the literals of single precision."""
    return _LITERAL.sub(lambda found: found[0] + "f", text)
