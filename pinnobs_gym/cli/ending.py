"""The end of the process of a command."""

from __future__ import annotations

import os
import sys
import threading
import time
from contextlib import suppress
from typing import Any, NoReturn

GRACE = 5.0
"""Seconds after which the process ends without waiting any longer."""


def end(status: int) -> NoReturn:
    """End this process with a status, also if a plug-in has left threads or processes of
    multiprocessing running: Python would wait for them for ever."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # it is closed, or nobody reads it
            stream.flush()
    multiprocessing: Any = sys.modules.get("multiprocessing")
    for child in () if multiprocessing is None else multiprocessing.active_children():
        if type(child).__module__.startswith("multiprocessing."):  # loky ends its own
            child.kill()
    threading.Thread(target=_end_after_grace, args=(status,), daemon=True).start()
    sys.exit(status)


def _end_after_grace(status: int) -> None:
    time.sleep(GRACE)
    os._exit(status)
