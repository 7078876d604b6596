import gymnasium as gym
import pytest

from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.systems import SYSTEMS


@pytest.fixture(autouse=True)
def registries_as_they_were():
    """What a test registers is gone after it."""
    registries = (SYSTEMS, ESTIMATORS)
    before = [registry.classes() for registry in registries]
    ids = set(gym.registry)
    yield
    for registry, classes in zip(registries, before, strict=True):
        registry._classes = classes
    for name in set(gym.registry) - ids:
        del gym.registry[name]
