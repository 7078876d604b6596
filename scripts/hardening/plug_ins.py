"""Estimators that misbehave, written as a module for the workers of a run."""

from __future__ import annotations

import textwrap
from pathlib import Path

MODULE = "misbehaving"
RAISING = {
    "exits": "sys.exit(3)",
    "exits_well": "sys.exit(0)",
    "raises_base": "raise Base('stop')",
    "raises_generator_exit": "raise GeneratorExit",
    "raises_unreadable": "raise Unreadable",
    "raises_long": "raise RuntimeError('x' * 10**6)",
    "raises_escape": "raise RuntimeError('\\x1b[2J\\n\\x1b]0;t\\x07')",
    "recurses": "self.run(record)",
    "allocates": "np.zeros(2**60)",
    "divides": "1 / 0",
}
"""What ends one job."""
DISTURBING = {
    "closes_stdout": "sys.stdout.close()",
    "changes_folder": "os.chdir('/')",
    "handles_signals": "signal.signal(signal.SIGTERM, signal.SIG_IGN)",
    "seeds": "np.random.seed(0); random.seed(0)",
    "raises_on_underflow": "np.seterr(all='raise')",
    "makes_warnings_errors": "warnings.simplefilter('error')",
    "leaves_a_thread": "threading.Thread(target=time.sleep, args=(3,)).start()",
    "prints": "print('x' * 10**6)",
    "changes_locale": "os.environ['LC_ALL'] = 'x'",
}
"""What may not disturb the jobs after it."""
DYING = {
    "ends_at_once": "os._exit(5)",
    "ends_well_at_once": "os._exit(0)",
    "is_killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "fails_in_c": "import ctypes; ctypes.string_at(0)",
}
"""What ends a process."""
WAITING = {"slow": "time.sleep(0.2)", "hangs": "time.sleep(10**6)"}
_HEAD = """
import os, random, signal, sys, threading, time, warnings
import numpy as np
from pinnobs_gym.estimators.open_loop import OpenLoop


class Base(BaseException):
    pass


class Unreadable(Exception):
    def __str__(self):
        raise RuntimeError("no text")

    __repr__ = __str__
"""
_CLASS = """

class {name}(OpenLoop):
    name = "{name}"

    def run(self, record):
        {does}
        return super().run(record)
"""


def write(folder: Path) -> None:
    """Write the module into a folder."""
    everything = {**RAISING, **DISTURBING, **DYING, **WAITING}
    classes = (_CLASS.format(name=name, does=does) for name, does in everything.items())
    (folder / f"{MODULE}.py").write_text(textwrap.dedent(_HEAD) + "".join(classes))


def spec(name: str) -> str:
    """Return how a command line names one of them."""
    return f"{MODULE}:{name}"
