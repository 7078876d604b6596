"""What is not read, since it might never end."""

from __future__ import annotations

from pathlib import Path


def check_ends(path: Path) -> None:
    """Check that reading a path to its end is possible. A pipe ends with what writes to it.

    Raises:
        OSError: if the path is a device or a link to one, such as ``/dev/zero``.
    """
    if path.is_char_device() or path.is_block_device():
        raise OSError("it is a device; expected a file")
