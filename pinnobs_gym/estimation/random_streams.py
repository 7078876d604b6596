"""Random streams of estimators: one for each sample, so that results can be reproduced."""

from __future__ import annotations

import numpy as np


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
