"""Files of trainings whose entries are of other types than those written."""

import pytest
import torch
from small_trainings import constant_gain

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.pinn_obs import TrainedNetwork
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import trainer_of
from pinnobs_gym.training.checkpoint import load_checkpoint, save_checkpoint


@pytest.mark.parametrize(
    ("entry", "value", "message"),
    [
        ("ending", "xx", "ending='xx'; expected running, finished, budget or interrupted"),
        ("seconds", "xx", "seconds='xx'; expected a number"),
        ("seed", True, "seed=True; expected a whole number"),
        ("noise_std", "ab", "noise_std='ab'; expected a list of numbers"),
        ("layers", "ab", "layers='ab'; expected a list of"),
        ("t", [1.0], "t=.*; expected a value of type ndarray"),
        ("architecture", 3, ""),
    ],
)
def test_a_trained_file_with_an_entry_of_another_type(tmp_path, entry, value, message):
    system, path = SYSTEMS.resolve("ReverseDuffing")(), tmp_path / "trained.pt"
    constant_gain(system, [[1.0], [2.0]]).save(path)
    content = torch.load(path)
    content["fields"][entry] = value
    torch.save(content, path)
    with pytest.raises(ValueError, match=rf"trained.pt is not a saved \w+: {message}") as error:
        TrainedNetwork.load(path, system)
    assert "\n" not in str(error.value)


def test_values_that_an_inner_dataclass_refuses_are_those_of_the_file(tmp_path):
    system, path = SYSTEMS.resolve("ReverseDuffing")(), tmp_path / "trained.pt"
    constant_gain(system, [[1.0], [2.0]]).save(path)
    content = torch.load(path)
    content["fields"]["architecture"]["depth"] = 0
    torch.save(content, path)
    with pytest.raises(ValueError, match=r"trained.pt is not a saved .*: depth=0; expected"):
        TrainedNetwork.load(path, system)


@pytest.mark.parametrize(
    ("entry", "value"), [("iteration", "x"), ("iteration", [1]), ("seconds", None)]
)
def test_a_checkpoint_with_an_entry_of_another_type(tmp_path, entry, value):
    config = TRAINERS.resolve("pinn_obs").configured({"depth": 1, "width": 3})
    game, path = Game.of("ReverseDuffing"), tmp_path / "checkpoint.pt"
    save_checkpoint(trainer_of("pinn_obs", config, game), path)
    content = torch.load(path)
    content[entry] = value
    torch.save(content, path)
    with pytest.raises(ValueError, match=rf"checkpoint.pt is not a .*: {entry}=.*; expected"):
        load_checkpoint(trainer_of("pinn_obs", config, game), path)
