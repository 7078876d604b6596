"""The loop of all trainings."""

from dataclasses import replace

import numpy as np
import pytest

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.pinn_obs import PinnObs
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.training.checkpoint import load_checkpoint, save_checkpoint
from pinnobs_gym.training.loop import train

SMALL = {"episodes": 8, "held_out": 3, "width": 4, "streams": 6, "chunk": 10, "check_every": 1}
GAME = Game.of("ReverseDuffing")
RECORD = GAME.record(range(8))


def trainer(record=RECORD, **settings):
    cls = TRAINERS.resolve("pinn_gain")
    return cls(GAME.source.system, cls.configured({**SMALL, **settings}), record=record)


def interrupted_at(monkeypatch, iteration):
    """These trainings are interrupted in this iteration."""
    for name in ("pinn_gain", "pinn_obs"):
        cls = TRAINERS.resolve(name)

        def step(self, original=cls.step):
            if self.iteration == iteration:
                raise KeyboardInterrupt
            original(self)

        monkeypatch.setattr(cls, "step", step)


def test_an_interrupted_training_goes_on_when_it_is_called_again(monkeypatch):
    straight = train(trainer(iterations=6))
    stopped = trainer(iterations=6)
    with monkeypatch.context() as patch:
        interrupted_at(patch, 3)
        assert train(stopped).ending == "interrupted"
    again = train(stopped)
    assert (again.ending, again.iterations) == ("finished", 6)
    for layer, other in zip(again.layers, straight.layers, strict=True):
        np.testing.assert_array_equal(layer[0], other[0])


def test_a_record_of_another_prior_is_another_record(tmp_path):
    path = tmp_path / "checkpoint.pt"
    first = trainer(iterations=6)
    first.step()
    save_checkpoint(first, path)
    load_checkpoint(trainer(iterations=6), path)
    wide = Prior(RECORD.prior.mean, 9 * RECORD.prior.cov)
    other = trainer(replace(RECORD, prior=wide), iterations=6)
    with pytest.raises(ValueError, match="trained on another record: its P0 differs"):
        load_checkpoint(other, path)


def test_an_interrupted_training_on_a_record_is_no_estimate(monkeypatch):
    recipe = TRAINERS.resolve("pinn_obs").configured({"iterations": 50, "depth": 1, "width": 4})
    estimator = PinnObs(GAME.source.system, config=recipe)
    interrupted_at(monkeypatch, 5)
    with pytest.raises(KeyboardInterrupt):
        estimator.run(RECORD)
