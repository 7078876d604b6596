"""Files with a wrong bit or an end too early, and disks that are full."""

import random
import signal
from contextlib import contextmanager

import pytest

try:
    import resource
except ImportError:  # Windows
    resource = None


def damaged(path, count, seed=0):
    """Write the file with one flipped bit, then cut off, each time in another place; yield what
    was done. It is as before at the end."""
    whole, random_places = path.read_bytes(), random.Random(seed)
    places = random_places.sample(range(8 * len(whole)), count)
    for place in places:
        wrong = bytearray(whole)
        wrong[place // 8] ^= 1 << place % 8
        path.write_bytes(bytes(wrong))
        yield f"bit {place}"
    for end in sorted({0, 1, len(whole) - 1, *random_places.sample(range(len(whole)), count // 4)}):
        path.write_bytes(whole[:end])
        yield f"cut to {end} bytes"
    path.write_bytes(whole)


@contextmanager
def full_disk(size):
    """For the system no file of this process can become larger than a number of bytes."""
    if resource is None:
        pytest.skip("this system limits no sizes of files")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, handler)


def is_one_line_about(error, path):
    """Whether a message is one line that names a file."""
    return "\n" not in str(error) and str(path) in str(error)
