"""What an estimator trained on one record is worth on others."""

import numpy as np
import pytest
from small_trainings import Spring, constant_gain

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.estimators.pinn_obs import PinnObsReplay
from pinnobs_gym.scoring.acceptance import ELSEWHERE, Elsewhere, elsewhere
from pinnobs_gym.scoring.playing import play


@pytest.mark.parametrize("setup", ["benchmark", "paper"])
def test_a_gain_of_zero_is_the_model_alone_and_worth_nothing(setup):
    game = Game.of("Academic", setup, duration=4.0)
    system, record = game.source.system, game.record([7])
    replay = PinnObsReplay(system, trained=constant_gain(system, [[0.0], [0.0]], record))
    found = elsewhere(replay, game)
    assert found is not None
    assert found.nrmse == pytest.approx(found.alone, rel=1e-6)
    assert not found.worth
    assert found.line.startswith("worth nothing on other records: of 10 from the initial set ")


def test_a_filter_is_worth_something_on_every_record():
    game = Game.of("Academic", duration=4.0)
    found = elsewhere(EKF.for_setup(game.source.system, game.source.setup), game)
    played = play(game, EKF.for_setup(game.source.system, game.source.setup), range(ELSEWHERE))
    assert found is not None
    assert found.nrmse == pytest.approx(np.median(played.scores_alone.nrmse))
    assert found.worth
    assert found.line.startswith("worth something on other records: of 10 from ")


def test_one_that_diverges_somewhere_is_worth_nothing():
    assert Elsewhere(0.1, 1.0, 0, 10).worth
    assert not Elsewhere(0.1, 1.0, 1, 10).worth
    assert not Elsewhere(0.6, 1.0, 0, 10).worth
    assert not Elsewhere(np.inf, np.inf, 10, 10).worth


@pytest.mark.parametrize(
    ("nrmse", "diverged", "verdict"),
    [(0.5, 0, "something"), (0.6, 0, "little"), (0.99, 0, "nothing"), (0.1, 1, "nothing")],
)
def test_the_verdict_is_no_harsher_than_the_figures(nrmse, diverged, verdict):
    line = Elsewhere(nrmse, 1.0, diverged, 10).line
    assert line.startswith(f"worth {verdict} on other records: of 10 from the initial set")


def test_a_set_of_one_state_has_no_elsewhere():
    game = Game.of(Spring)
    replay = PinnObsReplay(
        Spring(), trained=constant_gain(Spring(), [[1.0], [0.0]], game.record([0]))
    )
    assert elsewhere(replay, game) is None
