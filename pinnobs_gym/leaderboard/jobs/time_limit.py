"""The time limit of a job, and what is left in a file where it was exceeded.

A timer of `faulthandler` ends the process. It needs neither the main thread nor the lock of the
interpreter, so that it ends whatever code hangs, and it writes where the code was.
"""

from __future__ import annotations

import faulthandler
import re
import sysconfig
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TIME_LIMIT = 7200.0
"""Default time limit of a job in s of wall-clock time, without its training."""
_LONGEST = 4e6
"""Limits above this number of s are none: Windows has no longer timer."""


@contextmanager
def limited(seconds: float | None, path: Path) -> Iterator[None]:
    """End this process if the context lasts longer than so many s; None for no limit.

    Args:
        seconds: the limit.
        path: a file that exists for the duration of the context, and after it if the process ends
            in the context. `exceeded` reads it.

    Raises:
        OSError: if the file cannot be written.
    """
    if seconds is None or seconds > _LONGEST:
        yield
        return
    with path.open("w", encoding="utf-8") as file:
        file.write(f"{seconds:g}\n")
        file.flush()
        faulthandler.dump_traceback_later(seconds, exit=True, file=file)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
    path.unlink(missing_ok=True)


def exceeded(path: Path, within: str) -> str | None:
    """Return in one line that the limit was exceeded, and where the code was; None if it was not.

    Args:
        path: the file given to `limited`.
        within: name of the file with the function that the thread of the job runs.
    """
    try:
        limit, _, trace = path.read_text(encoding="utf-8", errors="replace").partition("\n")
    except OSError:
        return None
    if not trace:
        return None
    message = f"no end within the time limit of {limit} s"
    for thread in re.split(r"\n(?=Thread |Current thread )", trace):
        calls = re.findall(r'File "(.*)", line (\d+) in (.*)', thread)
        if any(file.endswith(within) for file, _, _ in calls):
            own = [call for call in calls if not _is_library(call[0])]
            file, line, function = (own or calls)[0]
            message += f"; it was in {function} ({Path(file).name}, line {line})"
    return message


def _is_library(file: str) -> bool:
    """Return whether a file is of Python or of an installed package."""
    library = sysconfig.get_path("stdlib"), "<"  # parts of Python are frozen
    return "site-packages" in file or file.startswith(library)
