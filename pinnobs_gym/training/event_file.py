"""TensorBoard's event files, written by the calling thread, which thus gets the errors."""

from __future__ import annotations

import itertools
import os
import secrets
import socket
import time
from pathlib import Path
from typing import Any

FLUSH = 10.0
"""Longest time in s for which events that were added stay in memory while others follow."""
_NUMBERS = itertools.count()
"""Numbers of the files of this process, in whose order TensorBoard reads those of one second."""


class EventFile:
    """A new event file.

    A record is the length of an event, a checksum of that, the event, and a checksum of the event
    (`tensorboard.summary.writer.record_writer`). TensorBoard leaves out an incomplete record at the
    end of a file.

    Args:
        folder: the folder of the file, which exists.

    Raises:
        OSError: if it cannot be written; as do all methods.
    """

    def __init__(self, folder: Path) -> None:
        from tensorboard.summary.writer.record_writer import RecordWriter

        place = f"{socket.gethostname()}.{os.getpid()}.{next(_NUMBERS)}.{secrets.token_hex(4)}"
        path = folder / f"events.out.tfevents.{int(time.time()):010d}.{place}"
        self._file = path.open("xb")
        self._records = RecordWriter(self._file)
        self._flushed = time.monotonic()
        self._write(file_version="brain.Event:2")

    def add(self, value: Any, step: int) -> None:
        """Add a value of a summary at a step."""
        from tensorboard.compat.proto import summary_pb2

        generated: Any = summary_pb2
        self._write(step=step, summary=generated.Summary(value=[value]))
        if time.monotonic() - self._flushed > FLUSH:
            self._flushed = time.monotonic()
            self._file.flush()

    def close(self) -> None:
        """Write what is in memory, and close the file."""
        self._file.close()

    def _write(self, **content: Any) -> None:
        from tensorboard.compat.proto import event_pb2

        generated: Any = event_pb2
        self._records.write(generated.Event(wall_time=time.time(), **content).SerializeToString())
