"""TensorBoard's event files, written by the calling thread, which thus gets the errors."""

from __future__ import annotations

import io
import itertools
import os
import secrets
import socket
import time
from io import FileIO
from pathlib import Path
from typing import Any

from pinnobs_gym.files import write_whole

_NUMBERS = itertools.count()
"""Numbers of the files of this process, in whose order TensorBoard reads those of one second."""


class EventFile:
    """A new event file, to which whole events are appended: on a full disk it holds those before,
    and the part of the one that does not fit is given back.

    Args:
        folder: the folder of the file, which exists.

    Raises:
        OSError: if it cannot be written; as does `add`.
    """

    def __init__(self, folder: Path) -> None:
        place = f"{socket.gethostname()}.{os.getpid()}.{next(_NUMBERS)}.{secrets.token_hex(4)}"
        path = folder / f"events.out.tfevents.{int(time.time()):010d}.{place}"
        first = _record(file_version="brain.Event:2")
        self._file = FileIO(path, "x")
        try:
            write_whole(self._file, first, durable=False)
        except OSError:
            self.close()
            raise

    def add(self, value: Any, step: int) -> None:
        """Add a value of a summary at a step."""
        from tensorboard.compat.proto import summary_pb2

        generated: Any = summary_pb2
        record = _record(step=step, summary=generated.Summary(value=[value]))
        write_whole(self._file, record, durable=False)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _record(**content: Any) -> bytes:
    """Return an event as it is in a file: its length, a checksum of that, the event and its
    checksum."""
    from tensorboard.compat.proto import event_pb2
    from tensorboard.summary.writer.record_writer import RecordWriter

    generated: Any = event_pb2
    event, record = generated.Event(wall_time=time.time(), **content), io.BytesIO()
    RecordWriter(record).write(event.SerializeToString())
    return record.getvalue()
