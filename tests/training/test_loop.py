"""The loop of all trainings."""

import os
from dataclasses import replace

import numpy as np
import pytest
from damage import damaged, full_disk, is_one_line_about

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimation.learned.trained_file import with_arrays
from pinnobs_gym.estimators.pinn_obs import PinnObs
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.simulation.code_hash import content
from pinnobs_gym.simulation.record import Prior
from pinnobs_gym.training import loop
from pinnobs_gym.training.checkpoint import load_checkpoint, save_checkpoint
from pinnobs_gym.training.log import SILENT
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


def test_a_training_outlives_a_checkpoint_that_cannot_be_written(tmp_path, caplog):
    checkpoint = tmp_path / "checkpoint.pt"
    train(trainer(iterations=2), checkpoint=checkpoint)
    before = checkpoint.read_bytes()
    with full_disk(100):
        trained = train(
            trainer(iterations=4, checkpoint_every=1), checkpoint=checkpoint, resume=True
        )
    assert (trained.ending, trained.iterations) == ("finished", 4)
    (line,) = caplog.messages
    assert line.startswith(f"cannot write {checkpoint}: ")
    assert line.endswith("the training goes on, and the checkpoint before is kept")
    assert checkpoint.read_bytes() == before
    assert os.listdir(tmp_path) == ["checkpoint.pt"]


def test_every_flipped_bit_of_a_checkpoint_is_noticed(tmp_path):
    checkpoint = tmp_path / "checkpoint.pt"
    first = trainer(iterations=4)
    first.step()
    save_checkpoint(first, checkpoint)
    refused, same = [], 0
    other = trainer(iterations=4)
    for change in damaged(checkpoint, 24):
        try:
            load_checkpoint(other, checkpoint)
        except ValueError as error:
            refused.append(error)
        else:
            state, expected = (content(with_arrays(each.state())) for each in (other, first))
            assert state == expected, change
            same += 1
    assert len(refused) > same
    assert all(is_one_line_about(error, checkpoint) for error in refused)


@pytest.mark.parametrize(("seconds", "shown"), [(0.0, 0.01), (5.0, 0.5), (30.0, 1.0)])
def test_progress_is_that_of_whatever_ends_the_training_first(monkeypatch, seconds, shown):
    """After one of a hundred iterations, with a budget of 10 s."""
    made = trainer(iterations=100, budget=10.0)
    made.step()
    monkeypatch.setattr(type(made), "seconds", property(lambda self: seconds))
    found = []
    loop._show(made, SILENT, lambda part, words: found.append((part, words)))
    ((part, words),) = found
    assert part == pytest.approx(shown)
    assert words.startswith("1 iterations, loss ")
