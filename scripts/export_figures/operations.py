"""Floating-point operations of exported code, counted by its execution.

The compiler's coverage tells how often each line is executed. Operations are counted in the text of
the line: additions, subtractions, multiplications and divisions outside of subscripts, and calls of
mathematical functions.
"""

from __future__ import annotations

import gzip
import json
import re
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

from export_figures.built import build, replay
from pinnobs_gym.estimation.export.c_files import CFiles

_HEAD = re.compile(r"\b(?:for|if|while|else if) \(")
_OPERATOR = re.compile(r"(?<=[\w)]) ?[-+*/]=? ?(?=[\w(.-])")
_CALL = re.compile(r"\b(?:sqrt|sin|cos|tan|exp|log|pow|atan2|tanh|fabs|floor|fmod|a?sinh|a?cosh)\(")
_SUBSCRIPT = re.compile(r"\[[^\[\]]*\]")


def operations(files: CFiles, text: str) -> float:
    """Return the mean number of operations of an update.

    Args:
        files: the exported estimator.
        text: the record that is replayed, as CSV.
    """
    source = apart(files.source)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program = build(folder, replace(files, source=source), ("-std=c99", "-O0", "--coverage"))
        found, _ = replay(program, text)
        command = ["gcov", "--json-format", f"replay-{files.name}.gcda"]
        subprocess.run(command, cwd=folder, capture_output=True, check=True)
        (data,) = folder.glob("*.gcov.json.gz")
        lines = json.loads(gzip.decompress(data.read_bytes()))["files"]
    (own,) = [each["lines"] for each in lines if each["file"].endswith(f"{files.name}.c")]
    rows = source.splitlines()
    counts = {line["line_number"]: line["count"] for line in own}
    total = sum(count * in_line(rows[number - 1]) for number, count in counts.items())
    return total / len(found)


def apart(source: str) -> str:
    """Return code in which what follows the head of a loop or a branch has a line of its own."""
    lines = []
    for line in source.splitlines():
        while (found := _HEAD.search(line)) and (end := _closing(line, found.end() - 1)) >= 0:
            if not line[end + 1 :].strip(" {"):
                break
            lines.append(line[: end + 1])
            line = line[end + 1 :]
        lines.append(line)
    return "\n".join(lines) + "\n"


def _closing(line: str, start: int) -> int:
    """Return the place of the parenthesis that closes that at a place, −1 if there is none."""
    depth = 0
    for i in range(start, len(line)):
        depth += {"(": 1, ")": -1}.get(line[i], 0)
        if depth == 0:
            return i
    return -1


def in_line(line: str) -> int:
    """Return the number of operations in the text of a line."""
    if line.lstrip().startswith(("for ", "/*", "#", "static", "struct")):
        return 0
    text = re.sub(r"/\*.*?\*/", "", line)
    while _SUBSCRIPT.search(text):
        text = _SUBSCRIPT.sub("", text)
    text = text.replace("->", ".").replace("++", "").replace("--", "")
    return len(_OPERATOR.findall(text)) + len(_CALL.findall(text))
