"""What names in tables say of an estimator's settings."""

from dataclasses import replace

import pytest

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_obs import PinnObs
from pinnobs_gym.scoring.deviations import deviations
from pinnobs_gym.scoring.evaluation import evaluate
from pinnobs_gym.systems.reverse_duffing import ReverseDuffing
from pinnobs_gym.systems.satellite import Satellite

DUFFING = Game.of("ReverseDuffing")


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({}, {}),
        ({"gate": 0.9}, {"gate": 0.9}),
        ({"assumed_noise": 3e-3}, {}),  # the default
        ({"assumed_noise": 0.1, "huber": 1.5}, {"huber": 1.5, "assumed_noise": 0.1}),
        ({"noise_std": 1.0}, {"noise_std": 1.0}),
        ({"noise_std": 0.02}, {}),  # that of the setup
        ({"process_noise": 0.0}, {}),  # that of the setup
        ({"process_noise": 0.1}, {"process_noise": [0.1, 0.1]}),
        ({"process_noise": [[0.1], [0.2]]}, {"process_noise": [[0.1], [0.2]]}),
    ],
)
def test_options_and_noise(options, expected):
    assert deviations(EKF(ReverseDuffing(), **options), DUFFING) == expected


def test_a_model_with_other_parameters():
    model = replace(Satellite(), a1=0.7)
    assert deviations(EKF(model), Game.of("Satellite")) == {"a1": 0.7}
    # Under mismatch the plant differs, and estimators keep the model.
    assert deviations(EKF(Satellite()), Game.of("Satellite", condition="mismatch10")) == {}


def test_noise_that_a_condition_makes_known_is_no_deviation():
    loud = Game.of("ReverseDuffing", condition="noise5")
    known = EKF.for_setup(loud.source.system, loud.source.setup)
    assert deviations(known, loud) == {}
    assert deviations(EKF(ReverseDuffing()), loud) == {"noise_std": 0.02}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, {}),
        ({"budget": 9.0, "seed": 3}, {}),
        ({"width": 8}, {"width": 8}),
        ({"preset": "transfer"}, {"preset": "transfer"}),
        ({"preset": "transfer", "width": 8}, {"preset": "transfer", "width": 8}),
        ({"preset": "plain"}, {}),  # the recipe in the name says it
        ({"preset": "plain", "w_y": 3.0}, {"w_y": 3.0}),
        ({"preset": "paper", "iterations": 100}, {"iterations": 100}),
    ],
)
def test_settings_of_a_training_and_presets(changes, expected):
    estimator = PinnObs(ReverseDuffing(), config=PinnObs.trainer_config(changes))
    assert deviations(estimator, DUFFING) == expected


def test_a_training_under_another_condition_is_named():
    class Trained(EKF):
        trained_under = "nominal"

        @property
        def training(self):
            return {"condition": self.trained_under}

    estimator = Trained(ReverseDuffing())
    assert "trained_under" not in deviations(estimator, DUFFING)
    Trained.trained_under = "noise5"
    assert deviations(estimator, DUFFING)["trained_under"] == "noise5"
    loud = Game.of("ReverseDuffing", condition="noise5")
    assert "trained_under" not in deviations(estimator, loud)  # has a track of its own


def test_rows_have_them():
    (row,) = evaluate("ekf", "ReverseDuffing", episodes=1, options={"gate": 0.9})
    assert row["settings"] == {"gate": 0.9}
