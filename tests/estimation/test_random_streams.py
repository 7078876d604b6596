"""Random streams are those of NumPy."""

import numpy as np
import pytest

from pinnobs_gym.estimation.random_streams import generator


@pytest.mark.parametrize("key", [(0, 0), (0, 5), (7, 2**32 + 3), (2**70 + 1, 0, 12), (1, 2, 3)])
def test_a_stream_is_that_of_numpy(key):
    expected = np.random.default_rng(list(key)).standard_normal(4)
    np.testing.assert_array_equal(generator(*key).standard_normal(4), expected)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match=r"^seed=-1; expected at least 0$"):
        generator(-1, 3)
