import gymnasium as gym
import pytest

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.systems import SYSTEMS


@pytest.fixture(autouse=True)
def registries_as_they_were():
    """What a test registers is gone after it."""
    ids = set(gym.registry)
    with SYSTEMS.isolated(), ESTIMATORS.isolated():
        yield
    for name in set(gym.registry) - ids:
        del gym.registry[name]
