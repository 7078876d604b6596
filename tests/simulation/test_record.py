import numpy as np
import pytest

from pinnobs_gym.simulation.record import Prior, Record
from pinnobs_gym.simulation.system import System
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing


def prior_of(cls: type[System]) -> Prior:
    system, setup = cls.configured()
    return Prior.of(system, setup, 1)


def test_record_checks_its_shapes():
    prior = prior_of(ReverseDuffing)
    with pytest.raises(ValueError, match=r"t must increase; sample 1 has t=0\.0 after 0\.0"):
        Record(np.zeros(2), np.zeros((1, 2, 1)), np.zeros((1, 2, 0)), prior)
    with pytest.raises(ValueError, match=r"y has shape \(2, 2, 1\); expected \(1, 2, ny\)"):
        Record(np.arange(2.0), np.zeros((2, 2, 1)), np.zeros((1, 2, 0)), prior)
