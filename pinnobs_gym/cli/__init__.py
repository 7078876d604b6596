"""The command line interface `pinnobs`; each command is a module of `pinnobs_gym.cli.commands`."""

from __future__ import annotations

import ast
import importlib
import os
import pkgutil
import sys
from collections.abc import Callable, Sequence
from importlib import resources
from io import TextIOWrapper
from typing import NoReturn

from pinnobs_gym.cli import commands
from pinnobs_gym.cli.ending import end
from pinnobs_gym.leaderboard.display import one_line, show_messages_printable, words_of
from pinnobs_gym.leaderboard.jobs.stopping import Stopped, stop_line
from pinnobs_gym.registry import error_line

COMMANDS = sorted(module.name for module in pkgutil.iter_modules(commands.__path__))
"""Names of the commands."""


class HelpShown(SystemExit):
    """The help of a command was printed."""


def usage() -> str:
    """Return the help text, with one line per command from the first line of its module."""
    lines = ["usage: pinnobs COMMAND ...", ""]
    for name in COMMANDS:
        source = resources.files(commands).joinpath(f"{name}.py").read_text(encoding="utf-8")
        docstring = ast.get_docstring(ast.parse(source)) or name  # importing the module is slow
        call, _, what = docstring.partition("\n")[0].partition(": ")
        lines.append(f"  {call.strip('`'):21} {what.rstrip('.')}")
    return "\n".join(
        [
            *lines,
            "",
            "pinnobs COMMAND --help says more. A system, estimator or trainer of your own is given "
            "as module:Class.",
            "With PINNOBS_TRACEBACK=1 in the environment an error shows where it came from.",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 for success, 1 if a job failed or an unexpected
    error occurred, 2 for invalid input, 130 after Ctrl-C, 143 after SIGTERM."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    _print_anything()
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    return guarded(lambda: _run(arguments[0], arguments[1:]))


def program() -> NoReturn:
    """Run the command of this process and end it; see `main`."""
    status = main()
    end(status)


def _run(name: str, arguments: Sequence[str]) -> int:
    if name not in COMMANDS:
        raise ValueError(f"unknown command {name!r}; known are {', '.join(COMMANDS)}")
    return importlib.import_module(f"{commands.__name__}.{name}").run(arguments)


def guarded(command: Callable[[], int]) -> int:
    """Run a command as a process of its own: with one numerical thread, and with errors told in one
    line. Returns its exit status, see `main`."""
    _print_anything()
    show_messages_printable()
    _one_thread()
    sys.path.append(os.getcwd())  # so that module:Class finds the user's own files
    try:
        return command()
    except (ValueError, TypeError, FloatingPointError) as error:
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        print(f"pinnobs: error: {words_of(error)}", file=sys.stderr)
        return 2
    except ConnectionError as error:  # connection lost to other machines during the run
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        print(f"pinnobs: error: {words_of(error)}", file=sys.stderr)
        return 1
    except OSError as error:
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        place = "" if error.filename is None else f"{error.filename}: "
        told = one_line(f"{place}{error.strerror}") if error.strerror else words_of(error)
        print(f"pinnobs: error: {told}", file=sys.stderr)
        return 2
    except Exception as error:  # a fault of a plug-in or of this package
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        return _fault(error)
    except HelpShown:
        raise
    except SystemExit as error:  # of a plug-in
        if os.environ.get("PINNOBS_TRACEBACK"):
            raise
        return _fault(error)
    except KeyboardInterrupt as stop:
        print(stop_line(stop), file=sys.stderr)
        return stop.status if isinstance(stop, Stopped) else 130


def _fault(error: BaseException) -> int:
    """Print what a plug-in or this package raised, and return the exit status."""
    line = f"pinnobs: error: {error_line(error)} (PINNOBS_TRACEBACK=1 shows where)"
    print(line, file=sys.stderr)
    return 1


def _print_anything() -> None:
    """Replace what the output cannot show: redirected output on Windows has few characters."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")


def _one_thread() -> None:
    """Limit numerical libraries to one thread unless OMP_NUM_THREADS is set: the arrays are so
    small that several threads mostly wait for each other."""
    if "OMP_NUM_THREADS" not in os.environ:
        from threadpoolctl import threadpool_limits

        os.environ["OMP_NUM_THREADS"] = "1"  # for libraries loaded later and for worker processes
        threadpool_limits(1)
