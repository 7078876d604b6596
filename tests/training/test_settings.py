"""Settings of trainers: wrong ones are refused in one line."""

from dataclasses import fields, replace

import numpy as np
import pytest

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.systems import SYSTEMS
from pinnobs_gym.training.by_name import trainer_of


@pytest.mark.parametrize("trainer", TRAINERS.sources)
@pytest.mark.parametrize("wrong", [object(), {}, np.zeros(2), b"1", "1\n2"])
def test_every_setting_of_every_trainer_refuses_another_type(trainer, wrong):
    config = TRAINERS.resolve(trainer).configured({})
    for field in fields(config):
        with pytest.raises(ValueError, match=rf"^{field.name}=.*; expected \w") as error:
            replace(config, **{field.name: wrong})
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("trainer", "settings", "message"),
    [
        ("pinn_gain", {"width": 8.0}, "width=8.0; expected a whole number"),
        ("pinn_gain", {"width": True}, "width=True; expected a whole number"),
        ("kkl_supervised", {"trajectories": 50.0}, "trajectories=50.0; expected a whole number"),
        ("kkl_supervised", {"depth": 2.0}, "depth=2.0; expected a whole number"),
        ("kkl_supervised", {"order": True}, "order=True; expected None or a whole number"),
        ("kkl_supervised", {"poles": "abc"}, "poles='abc'; expected a list of numbers"),
        ("kkl_supervised", {"poles": ["a"]}, r"poles=\['a'\]; expected a list of numbers"),
        ("kkl_supervised", {"transient": "no"}, "transient='no'; expected True or False"),
        ("kkl_supervised", {"noise": 3}, "noise=3; expected True or False"),
        ("kkl_supervised", {"mode": "x"}, "mode='x'; expected continuous or discrete"),
        ("kkl_supervised", {"budget": True}, "budget=True; expected None or a number"),
        ("kkl_autoencoder", {"seed": 2**70}, "expected a whole number from 0 to 4294967295"),
        ("rl", {"seed": -1}, "seed=-1; expected a whole number from 0 to 4294967295"),
        ("pinn_obs", {"points": 50.0}, "points=50.0; expected a whole number"),
        ("pinn_obs", {"preset": "paper", "points": -5}, "points=-5; expected a whole number of"),
        ("pinn_obs", {"transfer": "False"}, "transfer='False'; expected True or False"),
        (
            "pinn_obs",
            {"preset": []},
            r"preset=\[\]; expected one of guided, plain, transfer, paper",
        ),
    ],
)
def test_wrong_settings(trainer, settings, message):
    with pytest.raises(ValueError, match=message) as error:
        TRAINERS.resolve(trainer).configured(settings)
    assert "\n" not in str(error.value)


def test_every_preset_is_allowed_and_seeds_of_four_bytes_are():
    for trainer in TRAINERS.classes().values():
        for preset in trainer.presets:
            assert trainer.configured({"preset": preset, "seed": 2**32 - 1}).seed == 2**32 - 1


def test_a_list_is_as_good_as_a_tuple():
    config = TRAINERS.resolve("kkl_supervised").configured({"poles": [-1, -2.0]})
    assert config.poles == (-1, -2.0)


@pytest.mark.parametrize(
    ("estimator", "options", "message"),
    [
        ("ekf", {"gate": "x"}, "gate='x'; expected None or a number"),
        ("ekf", {"patience": 3.0}, "patience=3.0; expected a whole number"),
        ("enkf", {"members": True}, "members=True; expected a whole number"),
        ("particle", {"seed": "a"}, "seed='a'; expected a whole number"),
        ("luenberger", {"gain": "ab"}, "gain='ab'; expected None or a list of lists of numbers"),
        ("sliding_mode", {"layer": None}, "layer=None; expected a number"),
        ("batch_least_squares", {"shortest": 2.0}, "shortest=2.0; expected a whole number"),
        ("ukf", {"assumed_noise": "1"}, "assumed_noise='1'; expected a number"),
    ],
)
def test_settings_of_estimators_have_the_types_of_their_fields(estimator, options, message):
    with pytest.raises(ValueError, match=message):
        ESTIMATORS.resolve(estimator)(SYSTEMS.resolve("Academic")(), **options)


@pytest.mark.parametrize("noise", [-1.0, np.nan, np.inf, "ab", (0.1, 0.2)])
def test_a_trainer_refuses_a_noise_level_that_is_none(noise):
    trainer, game = TRAINERS.resolve("pinn_obs"), Game.of("Academic")
    with pytest.raises(ValueError, match=r"^noise_std(=.*)? of Academic.*; expected"):
        trainer(
            game.source.system, trainer.configured({}), record=game.record([0]), noise_std=noise
        )


def test_a_config_that_forgets_the_shared_checks_is_checked_by_its_trainer():
    class Forgetful(type(TRAINERS.resolve("pinn_obs").configured({}))):
        def __post_init__(self):
            pass

    game = Game.of("Academic")
    with pytest.raises(ValueError, match=r"width=8\.0; expected a whole number"):
        trainer_of("pinn_obs", Forgetful(width=8.0), game)


def test_a_negative_episode_is_named():
    config = TRAINERS.resolve("pinn_obs").configured({})
    with pytest.raises(ValueError, match="episode=-3; expected a whole number of at least 0"):
        trainer_of("pinn_obs", config, Game.of("Academic"), -3)
