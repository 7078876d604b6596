"""Waiting for other processes, on machines however slow or busy."""

import signal
import time

PATIENCE = 900
"""Seconds after which something hangs; nothing that is tested takes a tenth of it."""


def until(found):
    """What is found, once there is something."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        if result := found():
            return result
        time.sleep(0.02)
    raise AssertionError(f"it did not happen in {PATIENCE} s")


def heed_ctrl_c():
    """What a process that is to be interrupted runs first: Ctrl-C is ignored in background jobs,
    and children inherit that."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
