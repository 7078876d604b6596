"""Jobs of plug-ins that behave badly; in a module of its own, so that other processes can import
it."""

import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass

from simple_job import Simple


class Unreadable(Exception):
    """An error whose text cannot be read."""

    def __str__(self):
        raise SystemExit(3)

    __repr__ = __str__


def unreadable():
    raise Unreadable


def leave_thread():
    threading.Thread(target=time.sleep, args=(10_000,)).start()


def leave_process(path):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(10_000)"])
    path.write_text(str(child.pid))
    child.returncode = 0  # or else its destructor warns
    return child


def hang():
    while True:
        time.sleep(0.1)


class Unpicklable:
    def __reduce__(self):
        raise OSError("no\nway")


@dataclass(frozen=True)
class Hostile(Simple):
    """A job that does what its name says, then notes that it is done and by which process."""

    cargo: object = None

    def run(self):
        actions = {
            "unreadable": unreadable,
            "exit": sys.exit,
            "leave thread": leave_thread,
            "leave process": lambda: leave_process(self.folder / "child"),
            "hang": hang,
            "work": lambda: None,
        }
        actions[self.what]()
        self._note(f"done by {os.getpid()}")
