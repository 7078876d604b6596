"""Names that steer a terminal, or that other programs would take for markup or commands."""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
from collections.abc import Iterator
from random import Random

from hardening.material import Material
from hardening.trial import Trial, command, written

MOST = 150
PARTS = (
    "\x1b[2J",
    "\x1b]0;t\x07",
    "\x9b31m",
    "\u202e",
    "\u2066",
    "\u200b",
    "\r",
    "\n",
    "\t",
    "\x08",
    "\x00",
)
PARTS += (
    "\u2028",
    "\x85",
    "\ud800",
    "|",
    "`",
    "*",
    "_",
    "<b>",
    "</script>",
    "<!--",
    "&amp;",
    "\\",
    "{",
    "}",
)
PARTS += (
    "$x$",
    "%",
    "#",
    "~",
    "^",
    "'",
    '"',
    ",",
    ";",
    "=cmd|' /C calc'!A0",
    "@SUM(1)",
    "+1",
    "-1",
    "$(x)",
)
PARTS += (
    "[a](http://b)",
    "http://b",
    "{{7*7}}",
    "${7}",
    "__proto__",
    "é",
    "推",
    "a b",
    "ekf",
    "😀",
    "\\u0041",
)
FIELDS = ("env_id", "setup", "condition", "estimator", "track")
FORMATS = ("text", "markdown", "latex", "csv")


def hostile(rng: Random) -> str:
    """Return a name of hostile parts."""
    return "".join(rng.choices(PARTS, k=rng.randint(1, 4))).strip() or "x"


def _wrong(form: str, out: str) -> str:
    """Return what is wrong with a printed table, if anything is."""
    if form == "csv":
        cells = [cell for line in csv.reader(io.StringIO(out, newline="")) for cell in line]
        risky = [cell for cell in cells if re.match(r"[=@\t\r]", cell)]
        return f"a spreadsheet would compute {risky[0]!r}" if risky else ""
    bad = {character for character in out if not character.isprintable()} - {"\n"}
    return f"unseen characters {sorted(bad)!r}" if bad else ""


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield tables of rows with such a name, in each format, and messages that show one."""
    rows = [json.loads(line) for line in material.rows_file.read_bytes().splitlines()]
    path = material.file("named.jsonl")
    while True:
        name, field, form = hostile(rng), rng.choice(FIELDS), rng.choice(FORMATS)
        if rng.random() < 0.3:
            words = rng.choice((["systems"], ["estimators"], ["tables"], ["train"], []))
            yield command(
                [*words, name], [name[:5], repr(name)[1:6], "arguments", "command"], "refused"
            )
            continue
        data = "".join(json.dumps({**row, field: name}) + "\n" for row in rows).encode()
        words = ["tables", path, "--format", form]
        words += ["--table", "overview"] if form == "csv" else []
        trial = command(words, [str(path)], check=lambda out, form=form: _wrong(form, out))
        yield Trial(
            f"{form} of {field}={shlex.quote(ascii(name))}",
            lambda t=trial, d=data: (written(path, d), t.run())[1],
        )
