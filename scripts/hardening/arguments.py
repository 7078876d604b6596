"""Command lines with an argument that is not what was expected."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count
from pathlib import Path
from random import Random
from typing import Any

from hardening.material import SYSTEM, Material
from hardening.trial import Expected, Trial, command

MOST = 300
NO_NUMBERS = ("x", "", "nan", "1e400", "0x10", "1_0", "١", "１", "1,5", "--", "\x1b[2J", "1 2", "∞")
HUGE = (str(2**63), str(2**64), "9" * 5000, "1" + "0" * 30)
COUNTS = (*NO_NUMBERS, *HUGE[1:], "-1", "0", "1.5", "-9" * 30)
"""What is no number of episodes, processes or trials. More than 2⁶³ are more than there are."""
SEEDS = (*NO_NUMBERS, *HUGE, "-1", "1.5")
"""What is no seed."""
SIZES = ("x", "", "nan", "-1", "1e400", "inf", "1_0", "0x10", "١", "\x1b[2J", "1 2")
"""What is no standard deviation and no budget."""
NAMES = (
    "",
    " ",
    "nothing",
    "a:b",
    ":",
    "os:getcwd",
    "json:JSONDecoder",
    "../x",
    "\x1b[31mx",
    "x" * 5000,
)
NAMES += ("x\n", "\u202ex", "\ud800", "'", "$(x)", "--", "ekf:ekf", "no_module:X", "os.path:join")
"""What is no name of a system, an estimator, a condition or a setup."""
FILES = ("missing", ".", "/dev/null", "a" * 300, "", "\x1b[2J", "a\nb", "missing/x.csv", "\ud800")
"""What is no file that can be read."""
SETTINGS = ("x", "=", "x=1", "=1", "gate=", "gate=x", "gate=nan", "gate=-1", "assumed_noise=-1")
SETTINGS += (
    "assumed_noise=inf",
    "gate=1e400",
    "\x1b=1",
    "gate=1=1",
    "gate=1_0",
    "huber=" + "9" * 5000,
)
"""What is no setting of the EKF."""
COLUMNS = (
    "t",
    "t=",
    "=t",
    "t=a",
    "y1=1/0",
    "y1=__import__('os')",
    "y1={",
    "y1=" + "(" * 500,
    "q=t",
)
COLUMNS += ("t=t*nan", "y1=y1**y1**9", "y1=\x1b", "y1=y1;y1", "y1=lambda:0", "y1=(y1", "t=1e400*t")
"""What is no column of the log."""


def trials(material: Material, rng: Random) -> Iterator[Trial]:
    """Yield command lines, each right but for one option."""
    for number in count():
        yield _trial(material, rng, number)


Options = list[tuple[tuple[Any, ...], tuple[str, ...], tuple[str, ...]]]
"""Command lines that are right, options that are added, and values that these may not have."""


def _trial(material: Material, rng: Random, number: int) -> Trial:
    """Return a command line that writes to folders of its own."""
    options = _options(material, material.file(f"out{number}"), material.file(f"new{number}"))
    base, names, values = rng.choice(options)
    option, value = rng.choice(names), rng.choice(values)
    # An option that takes several values may have none.
    expected: Expected = "either" if value in ("", "--", "1 2", "1 2 3") else "refused"
    words = [*base, option, value] if option else [*filter(None, base), value]
    field = option.strip("-")
    known = [field, field.replace("-", "_"), value[:20], repr(value)[1:20], base[0] or "command"]
    known += [part[:20] for part in value.split("=")]
    return command(words, list(filter(None, known)), expected)


def _options(material: Material, out: Path, new: Path) -> Options:
    """Return what may be tried."""
    log = ("estimate", "--system", SYSTEM, "--log", material.log_file, "--estimator", "open_loop")
    log += ("--out", out / "estimates.csv")
    play = ("evaluate", "--system", SYSTEM, "--estimator", "open_loop", "--out", out)
    board = ("leaderboard", "--systems", SYSTEM, "--estimators", "open_loop", "--jobs", "1")
    board += ("--out", out)
    fit = ("fit", "--system", "Satellite", "--log", material.log_file, "--picture", out / "fit.png")
    return [
        (play, ("--episodes",), COUNTS),
        (play, ("--seed",), SEEDS),
        (("evaluate", "--system", SYSTEM), ("--set",), SETTINGS),
        (("evaluate",), ("--system",), NAMES),
        (play, ("--setup", "--condition"), NAMES),
        (("evaluate", "--system", SYSTEM), ("--estimator",), NAMES),
        (("evaluate", "--system", SYSTEM, "--estimator", "pinn_gain"), ("--trained",), FILES),
        (play, ("--against",), FILES),
        (board, ("--episodes", "--jobs", "--trained-episodes"), COUNTS),
        (board, ("--seed", "--training-seeds"), SEEDS),
        (board, ("--budget",), (*SIZES, "0")),
        (board[:1], ("--systems", "--estimators", "--setup", "--condition"), NAMES),
        (board, ("--suite",), FILES),
        (board, ("--scheduler", "--backend"), NAMES),
        (("episodes", "--system", SYSTEM, "-o", new), ("--episodes",), COUNTS),
        (("episodes", "--system", SYSTEM, "-o", new), ("--seed",), SEEDS),
        (("episodes", "--system", SYSTEM, "-o", new), ("--format", "--setup"), NAMES),
        (log, ("--noise-std", "--process-noise", "--P0-std"), SIZES),
        (log, ("--xhat0",), (*SIZES, "1", "1 2 3")),
        (log, ("--columns",), COLUMNS),
        (log[:3], ("--log",), FILES),
        (fit, ("--parameters",), (*NAMES, "a1=x", "a1=1,2", "a1=nan", "a1=1,3,2", "a1=")),
        (("tables",), ("",), FILES),
        (("report", "-o", out), ("",), FILES),
        (("tables", material.rows_file), ("--table", "--columns", "--format"), NAMES),
        (("systems",), ("",), NAMES),
        (("estimators",), ("",), NAMES),
        (("train",), ("",), NAMES),
        (("export",), ("",), NAMES),
        (("",), ("",), NAMES),
    ]
