"""The command line interface `pinnobs`; each command is a module of `pinnobs_gym.cli.commands`."""

from __future__ import annotations

import ast
import importlib
import os
import pkgutil
import platform
import sys
from collections.abc import Callable, Sequence
from importlib import resources
from importlib.metadata import version
from typing import NoReturn

from pinnobs_gym.cli import commands
from pinnobs_gym.cli.ending import end
from pinnobs_gym.cli.streams import print_anything, until_pipe_closes
from pinnobs_gym.leaderboard.display import one_line, show_messages_printable, words_of
from pinnobs_gym.leaderboard.jobs.stopping import Stopped, stop_line
from pinnobs_gym.registry import did_you_mean, error_line

COMMANDS = sorted(module.name for module in pkgutil.iter_modules(commands.__path__))
"""Names of the commands."""
_NO_MEMORY = "can't allocate memory", "CUDA out of memory"
"""What torch says if there is not enough, as a RuntimeError."""


EXTRAS = (
    'Extras, as in pip install "pinnobs-gym[report]": report (pinnobs report), tune (pinnobs '
    "tune), video (evaluate --video), parquet (episodes --format parquet), dask (leaderboard "
    "--backend dask), lmi (luenberger by an LMI), rl (recurrent agents)."
)
"""What the extras of the package are for."""


class HelpShown(SystemExit):
    """The help of a command was printed."""


def usage() -> str:
    """Return the help text, with one line per command from the first line of its module."""
    lines = ["usage: pinnobs COMMAND ... | --version", ""]
    for name in COMMANDS:
        source = resources.files(commands).joinpath(f"{name}.py").read_text(encoding="utf-8")
        docstring = ast.get_docstring(ast.parse(source)) or name  # importing the module is slow
        call, _, what = docstring.partition("\n")[0].partition(": ")
        lines.append(f"  {call.strip('`'):21} {what.rstrip('.')}")
    return "\n".join(
        [
            *lines,
            "",
            "pinnobs COMMAND --help says more. A system is given by its name or env id; one of "
            "your own, as an estimator or a trainer, by module:Class.",
            EXTRAS,
            "With PINNOBS_TRACEBACK=1 in the environment an error shows where it came from.",
            "",
            "next: pinnobs evaluate --system ReverseDuffing",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 for success, 1 if a job failed or an unexpected
    error occurred, 2 for invalid input, 130 after Ctrl-C, 141 if the reader of its output left, 143
    after SIGTERM."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments and arguments[0] in ("-V", "--version"):
        print(f"pinnobs-gym {version('pinnobs-gym')}, Python {platform.python_version()}")
        return 0
    if not arguments or arguments[0] in ("-h", "--help"):
        print_anything()
        return until_pipe_closes(lambda: _help(0 if arguments else 2))
    return guarded(lambda: _run(arguments[0], arguments[1:]))


def program() -> NoReturn:
    """Run the command of this process and end it; see `main`."""
    status = main()
    end(status)


def _help(status: int) -> int:
    print(usage())
    return status


def _run(name: str, arguments: Sequence[str]) -> int:
    if name not in COMMANDS:
        guess = did_you_mean(name, COMMANDS)
        raise ValueError(f"unknown command {name!r}; known are {', '.join(COMMANDS)}{guess}")
    return importlib.import_module(f"{commands.__name__}.{name}").run(arguments)


def guarded(command: Callable[[], int]) -> int:
    """Run a command as a process of its own: with one numerical thread, and with errors told in one
    line. Returns its exit status, see `main`."""
    print_anything()
    show_messages_printable()
    _one_thread()
    sys.path += _working_folder()  # so that module:Class finds the user's own files
    try:
        return until_pipe_closes(lambda: _status(command))
    except KeyboardInterrupt as stop:
        print(stop_line(stop), file=sys.stderr)
        return stop.status if isinstance(stop, Stopped) else 130
    except BaseException as error:  # a plug-in may raise anything
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        status, line = _told(error)
        print(f"pinnobs: error: {line}", file=sys.stderr)
        return status


def _status(command: Callable[[], int]) -> int:
    try:
        return command()
    except HelpShown:
        return 0


def _working_folder() -> list[str]:
    """Return the working folder in a list, which is empty if the folder has been deleted."""
    try:
        return [os.getcwd()]
    except OSError:
        return []


def _told(error: BaseException) -> tuple[int, str]:
    """Return the exit status of an error, and what is said of it."""
    if isinstance(error, OSError) and not _working_folder():
        return 2, "the working folder has been deleted; expected to run in one that exists"
    if isinstance(error, ValueError | TypeError | FloatingPointError):
        return 2, words_of(error)
    if isinstance(error, MemoryError) or any(each in words_of(error) for each in _NO_MEMORY):
        text = words_of(error) if error.args else "none is left"
        return 2, f"not enough memory: {text}; expected smaller sizes"
    if isinstance(error, ConnectionError):  # connection lost to other machines during the run
        return 1, words_of(error)
    if isinstance(error, OSError):
        place = "" if error.filename is None else f"{error.filename}: "
        return 2, one_line(f"{place}{error.strerror}") if error.strerror else words_of(error)
    # A fault of a plug-in or of this package.
    return 1, f"{error_line(error)} (PINNOBS_TRACEBACK=1 shows where)"


def _one_thread() -> None:
    """Limit numerical libraries to one thread unless OMP_NUM_THREADS is set: the arrays are so
    small that several threads mostly wait for each other."""
    if "OMP_NUM_THREADS" not in os.environ:
        from threadpoolctl import threadpool_limits

        os.environ["OMP_NUM_THREADS"] = "1"  # for libraries loaded later and for worker processes
        threadpool_limits(1)
