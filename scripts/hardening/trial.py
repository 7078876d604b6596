"""Trials: what is done, and whether it ended as it should."""

from __future__ import annotations

import contextlib
import io
import signal
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any, Literal, NamedTuple

from pinnobs_gym.cli import guarded, main
from pinnobs_gym.leaderboard.display import one_line

Kind = Literal["refused", "accepted", "traceback", "unnamed", "wrong", "hung"]
"""How a trial ended. ``refused``: in one line, status 2, which names the file, the field or the
argument; ``unnamed``: in one line that does not; ``traceback``: by an exception or an unexpected
error; ``wrong``: otherwise than it has to."""
RIGHT: tuple[Kind, ...] = ("refused", "accepted")
Expected = Literal["refused", "accepted", "either"]
LONGEST = 1100
"""Largest number of characters of a message."""
PATIENCE = 30
"""Seconds after which a trial in this process is taken to hang."""


class Outcome(NamedTuple):
    """How a trial ended."""

    kind: Kind
    told: str = ""
    """What was printed or is wrong."""


@dataclass(frozen=True)
class Trial:
    """One thing that is tried."""

    what: str
    """Description of the trial."""
    run: Callable[[], Outcome]
    """Tries it."""


class Ended(NamedTuple):
    """The end of a command."""

    status: int
    out: str
    err: str


class Hung(BaseException):
    """Raised in what runs for too long."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `Hung` after so many s in the context, on systems with such a signal."""
    if not hasattr(signal, "setitimer"):
        yield
        return

    fired: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        fired.append(number)
        raise Hung

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    if fired:  # what ran has caught it
        raise Hung


def ended(run: Callable[[], int]) -> Ended:
    """Run what returns the status of a command, and return what it printed.

    Raises:
        Hung: if it takes longer than `PATIENCE`.
    """
    out, err = io.StringIO(), io.StringIO()
    with time_limit(PATIENCE), contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = run()
        except SystemExit as end:
            status = end.code if isinstance(end.code, int) else 1
    return Ended(status, out.getvalue(), err.getvalue())


def judged(
    run: Callable[[], int], names: Sequence[str], expected: Expected, check: Callable[[str], str]
) -> Outcome:
    """Run what returns the status of a command, and judge its end.

    Args:
        run: runs it.
        names: of which a refusal has to name one.
        expected: how it has to end.
        check: returns what is wrong with the output of a command that accepts, or nothing.
    """
    try:
        end = ended(run)
    except Hung:
        return Outcome("hung", f"no end after {PATIENCE} s")
    except BaseException as error:
        return Outcome("traceback", f"{type(error).__name__}: {error}"[:LONGEST])
    lines = end.err.strip().split("\n")
    if end.status == 0:
        wrong = check(end.out)
        if wrong or expected == "refused":
            return Outcome("wrong", wrong or "it was accepted")
        return Outcome("accepted")
    if end.status != 2 or "Traceback" in end.err:
        return Outcome("traceback", f"status {end.status}: {lines[-1]}")
    told = lines[-1]
    if len(lines) > 1 or not told.startswith("pinnobs: error: ") or not told.isprintable():
        return Outcome("wrong", f"not one plain line: {end.err[:LONGEST]!r}")
    if len(told) > LONGEST:
        return Outcome("wrong", f"a line of {len(told)} characters: {told[:LONGEST]}...")
    if expected == "accepted":
        return Outcome("wrong", f"it was refused: {told}")
    named = any(name in told or one_line(name) in told for name in names if name)
    return Outcome("refused" if named else "unnamed", told)


def command(
    arguments: Sequence[Any],
    names: Sequence[str],
    expected: Expected = "either",
    check: Callable[[str], str] = lambda out: "",
) -> Trial:
    """Return the trial of a command line; see `judged`."""
    words = [str(argument) for argument in arguments]
    shown = " ".join(word if len(word) < 60 else f"{word[:57]}..." for word in words)
    return Trial(f"pinnobs {shown}", lambda: judged(lambda: main(words), names, expected, check))


def call(
    what: str,
    run: Callable[[], str | None],
    names: Sequence[str],
    expected: Expected = "either",
) -> Trial:
    """Return the trial of a function, as if a command were nothing else. It returns what is wrong
    with its result, if anything is."""
    found: list[str] = []

    def status() -> int:
        found[:] = [run() or ""]
        return 0

    return Trial(
        what,
        lambda: judged(
            lambda: guarded(status), names, expected, lambda out: found[0] if found else ""
        ),
    )


def written(path: Path, data: bytes) -> Path:
    """Write a file and return its path."""
    path.write_bytes(data)
    return path
