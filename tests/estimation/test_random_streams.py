"""Random streams are those of NumPy."""

import numpy as np
import pytest
from fake_compilers import needs_compiler
from linear import Linear

from pinnobs_gym.estimation.random_streams import Streams, generator
from pinnobs_gym.simulation.kernels.plant_library import plant_library


@pytest.mark.parametrize("key", [(0, 0), (0, 5), (7, 2**32 + 3), (2**70 + 1, 0, 12), (1, 2, 3)])
def test_a_stream_is_that_of_numpy(key):
    expected = np.random.default_rng(list(key)).standard_normal(4)
    np.testing.assert_array_equal(generator(*key).standard_normal(4), expected)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match=r"^seed=-1; expected at least 0$"):
        generator(-1, 3)


@needs_compiler
def test_streams_of_compiled_code_are_those_of_numpy():
    code = plant_library(Linear(), "ensemble").code
    for seed in (0, 7, 2**32, 2**70 + 1, 2**140 + 5):
        streams = Streams(seed, code)
        for stream in ((0,), (2**32 - 1,), (1, 12), (2, 2**32, 100)):
            found, expected = streams.at(*stream), generator(seed, *stream)
            np.testing.assert_array_equal(found.random(3), expected.random(3))
            assert found.integers(1 << 20) == expected.integers(1 << 20)
