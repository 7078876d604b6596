"""A job of the engine; in a module of its own, so that other processes can import it."""

import os
import signal
from dataclasses import dataclass
from pathlib import Path

from pinnobs_gym.files import CannotWrite


@dataclass(frozen=True)
class Simple:
    """A job that does one thing and says that it did."""

    folder: Path
    number: int
    what: str = "work"
    time_limit: float | None = None

    @property
    def name(self):
        return f"job {self.number}"

    def run(self):
        if self.what == "die":
            os.kill(os.getpid(), signal.SIGKILL)
        if self.what == "fail":
            raise RuntimeError("out\nof luck")
        if self.what == "fill":
            raise CannotWrite("the disk is full")
        self._note("done")

    def anew(self):
        return self

    def fail(self, error):
        self._note(error)

    def _note(self, text):
        with (self.folder / "notes").open("a") as file:
            file.write(f"{self.number} {text}\n")
