"""Output noise by sample, as compiled code takes it."""

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.estimation.compiled_code import noise_at
from pinnobs_gym.simulation.noise import AssumedNoise, SampledLevel

T = np.arange(5) * 0.1
SAME = np.repeat([[[0.1, 0.3]], [[0.2, np.nan]]], 5, axis=1)
OTHER = np.where(np.arange(5)[:, None] == 3, 0.7, SAME)


@pytest.mark.parametrize(("std", "different"), [(SAME, 1), (OTHER, 5)])
def test_noise_that_is_the_same_at_all_samples_is_found_once(std, different):
    level = SampledLevel(T, std, ((0.2, 0.0), (0.1, 0.4)))
    noise = AssumedNoise.of(Linear(), Linear().noise(level, 0.0))
    R = noise_at(noise, T)
    assert len(R) == different
    for k, t in enumerate(T):
        assert (np.broadcast_to(R, (5, *R.shape[1:]))[k] == noise.R(float(t))).all()


def test_times_of_no_sample_have_the_noise_of_the_others():
    level = SampledLevel(T, SAME, 0.5)
    noise = AssumedNoise.of(Linear(), Linear().noise(level, 0.0))
    R = noise_at(noise, np.r_[T[:2], 7.0])
    assert (R[2] == 0.25 * np.eye(2)[..., None]).all()
