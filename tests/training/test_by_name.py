"""Which episodes estimators are trained on."""

import numpy as np
import pytest

from pinnobs_gym import evaluate
from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.pinn_gain import PinnGain
from pinnobs_gym.leaderboard.jobs.job import Job, trained
from pinnobs_gym.leaderboard.jobs.trainings import training_of
from pinnobs_gym.registry import TRAINERS
from pinnobs_gym.training.by_name import train_by_name, trainer_of
from pinnobs_gym.training.trainer import first_episode

SMALL = {"episodes": 8, "held_out": 3, "width": 4, "iterations": 2, "streams": 6, "chunk": 10}


def small(seed=0):
    return TRAINERS.resolve("pinn_gain").configured({**SMALL, "seed": seed})


def test_trainings_of_different_seeds_have_different_episodes():
    game = Game.of("ReverseDuffing")
    first, second = (trainer_of("pinn_gain", small(seed), game).record for seed in (0, 1))
    np.testing.assert_array_equal(first.y, game.record(range(10**6, 10**6 + 8)).y)
    np.testing.assert_array_equal(second.y, game.record(range(1010000, 1010008)).y)
    chosen = trainer_of("pinn_gain", small(1), game, first_episode(0)).record
    np.testing.assert_array_equal(chosen.y, first.y)


def test_a_leaderboard_trains_under_nominal_whatever_is_scored(tmp_path):
    files = set()
    for condition in ("nominal", "noise5"):
        job = Job(
            Game.of("ReverseDuffing", condition=condition), "pinn_gain", 1, 0, tmp_path, SMALL
        )
        estimator = trained(training_of(job), job)
        assert estimator.trained.condition == "nominal"
        files |= set((tmp_path / "trained").iterdir())
    assert len(files) == 1


@pytest.mark.parametrize("condition", ["nominal", "noise5"])
def test_who_was_trained_under_the_condition_that_is_scored_is_ranked_apart(condition):
    game = Game.of("ReverseDuffing", condition="noise5")
    network = train_by_name("pinn_gain", small(), game if condition == "noise5" else game.nominal)
    assert network.condition == condition
    estimator = PinnGain(game.source.system, trained=network)
    env_id = "pinnobs/ReverseDuffing-v0"
    (row,) = evaluate(estimator, env_id, episodes=1, condition="noise5")
    (plain,) = evaluate(estimator, env_id, episodes=1)
    assert (plain["track"], "condition" in plain["knows"]) == ("online", False)
    informed = condition == "noise5"
    assert row["track"] == ("online, condition known" if informed else "online")
    assert ("condition" in row["knows"]) == informed
    assert "initial set" in row["knows"]
