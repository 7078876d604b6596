"""Random streams of estimators: one for each sample, so that results can be reproduced."""

from __future__ import annotations

import ctypes
import threading
from typing import Any

import numpy as np

_BITS = (1 << 128) - 1
_MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
"""That of PCG64, modulo 2¹²⁸ (O'Neill 2014)."""


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Return the random generator of a seed and the numbers of a stream, all at least 0: that of
    ``numpy.random.default_rng([seed, *stream])``.

    NumPy takes three quarters of its time for that to turn Python numbers into words of 32 bits;
    they are given as such here.
    """
    words = [word for number in (seed, *stream) for word in _words(number)]
    return np.random.default_rng(np.array(words, dtype=np.uint32))


def _words(number: int) -> list[int]:
    """Return the words of 32 bits of a number, the lowest first.

    Raises:
        ValueError: in one line, if the number is negative.
    """
    number = int(number)
    if number < 0:
        raise ValueError(f"seed={number}; expected at least 0")
    words = [number & 0xFFFFFFFF]
    while number := number >> 32:
        words.append(number & 0xFFFFFFFF)
    return words


class Streams(threading.local):
    """The random streams of a seed, as `generator` returns them, in a third of its time: one
    generator, in each thread that uses it, is placed at the start of a stream.

    Args:
        seed: the seed.
        code: compiled code with ``stream_seed`` of ``templates/streams.c``.
    """

    def __init__(self, seed: int, code: ctypes.CDLL) -> None:
        self._words = _words(seed)
        self._bits = np.random.PCG64(0)
        self._generator = np.random.Generator(self._bits)
        self._state: Any = self._bits.state
        self._seed = (ctypes.c_uint64 * 4)()
        self._place = ctypes.addressof(self._seed)
        self._stream_seed = code.stream_seed
        self._stream_seed.argtypes = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_void_p]
        self._stream_seed.restype = None

    def at(self, *stream: int) -> np.random.Generator:
        """Return the generator at the start of a stream. The next call in the same thread moves
        it."""
        if max(stream) >> 32:
            stream = tuple(word for number in stream for word in _words(number))
        size = len(self._words) + len(stream)
        words = (ctypes.c_uint32 * size)(*self._words, *stream)
        self._stream_seed(words, size, self._place)
        # The state that PCG64 starts from, given this seed
        first, second, third, fourth = self._seed
        increment = ((third << 64 | fourth) << 1 | 1) & _BITS
        state = ((increment + (first << 64 | second)) * _MULTIPLIER + increment) & _BITS
        self._state["state"] = {"state": state, "inc": increment}
        self._bits.state = self._state
        return self._generator
