"""A trainer refuses a plant that its estimators do not take before it does anything."""

from dataclasses import dataclass

import numpy as np
import pytest
from linear import Linear

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.takes import FEATURES, NotTaken
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import TRAINERS, trainer_name
from pinnobs_gym.training.by_name import trainer_of


@dataclass(frozen=True)
class Bounded(Linear):
    state_low = (-9.0, None)


@dataclass(frozen=True)
class Stiff(Linear):
    stiff = True


@dataclass(frozen=True)
class Turning(Linear):
    output_period = (9.0, None)


@dataclass(frozen=True)
class Own(Linear):
    def flow(self, t0, t1, x, u):
        return x * np.exp(-np.asarray(t1 - t0))[..., None]


NAMES = ["rl", "pinn_gain", "pinn_obs", "kkl_supervised", "kkl_autoencoder", "kkl_pinn"]
PLANTS = {"bounds": Bounded, "stiff": Stiff, "output_period": Turning, "own_flow": Own}


@pytest.mark.parametrize("name", NAMES)
def test_a_trainer_takes_what_its_estimators_take(name):
    cls = TRAINERS.resolve(name)
    needing = [kind for kind in ESTIMATORS.classes().values() if trainer_name(kind) == name]
    assert needing
    for kind in needing:
        assert kind.takes == cls.takes


@pytest.mark.parametrize("feature", PLANTS)
@pytest.mark.parametrize("name", NAMES)
def test_what_is_not_taken_is_refused_before_the_training(name, feature, monkeypatch):
    cls = TRAINERS.resolve(name)
    started = []
    monkeypatch.setattr(cls, "start", lambda self: started.append(self))
    game = Game.of(PLANTS[feature])
    if feature in cls.takes:
        trainer_of(name, cls.configured({}), game)
        assert started
        return
    with pytest.raises(NotTaken, match=f"^{cls.__name__} does not take .*") as caught:
        trainer_of(name, cls.configured({}), game)
    assert f"takes no {FEATURES[feature]}" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert not started
