"""An episode has the same scores alone and in a batch."""

import numpy as np
import pytest

from pinnobs_gym.envs.game import Game
from pinnobs_gym.estimators import ESTIMATORS
from pinnobs_gym.scoring.evaluation import make_estimator
from pinnobs_gym.scoring.playing import play
from pinnobs_gym.scoring.rows import TOLERANCE

UNTRAINED = [
    name
    for name, cls in ESTIMATORS.classes().items()
    if cls.needs_training is None and cls.trains_on_record is None
]
DECIDING = ("batch_least_squares", "mhe", "particle")
"""Estimators that decide row by row when to stop, or what to draw anew."""
ALONE = (0, 3, 6)
"""Seeds of the episodes that are also played alone."""


def played(game, name, size=7):
    """Some episodes alone, by seed, and all of them in a batch of a size."""
    estimator = make_estimator(name, game, {})
    alone = {seed: play(game, estimator, [seed]) for seed in ALONE}
    return alone, play(game, estimator, range(size))


def assert_same_scores(alone, together):
    rows = together.scores.rows()
    for seed, one in alone.items():
        (own,), row = one.scores.rows(), rows[seed]
        assert own.keys() == row.keys()
        states, expected = own.pop("state_rmse"), row.pop("state_rmse")
        for window, errors in states.items():
            assert expected[window] == pytest.approx(errors, rel=TOLERANCE / 100, abs=0)
        for name, value in own.items():
            expected = value if value is None else pytest.approx(value, rel=TOLERANCE / 100, abs=0)
            assert row[name] == expected, name


PLAYED = [
    (env_id, name)
    for env_id in ("pinnobs/Satellite-v0", "pinnobs/InductionMotor-v0")  # 3 states; 2 outputs
    for name in UNTRAINED
    if env_id != "pinnobs/InductionMotor-v0" or name not in ("luenberger", "sliding_mode")
]
"""Gains of observers for the motor take seconds to design."""


@pytest.mark.parametrize(("env_id", "name"), PLAYED)
def test_an_episode_has_one_score_alone_and_in_a_batch(env_id, name):
    game = Game.of(env_id)
    game = Game.of(env_id, duration=30 * game.source.setup.dt)
    assert_same_scores(*played(game, name, 60 if name in DECIDING else 7))


@pytest.mark.parametrize("condition", ["dropout30", "outliers", "process_noise1e-2"])
@pytest.mark.parametrize("name", ["batch_least_squares", "ekf", "particle"])
def test_conditions_leave_rows_independent(condition, name):
    game = Game.of("pinnobs/Academic-v0", condition=condition, duration=0.6)
    assert_same_scores(*played(game, name))


@pytest.mark.parametrize("condition", ["nominal", "dropout30", "outliers", "process_noise1e-2"])
def test_true_states_and_outputs_do_not_depend_on_the_batch(condition):
    game = Game.of("pinnobs/Satellite-v0", condition=condition, duration=2.0)
    together = game.episodes(range(9))
    for seed in range(9):
        alone = game.episodes([seed])
        assert np.array_equal(alone.x[:, 0], together.x[:, seed])
        assert np.array_equal(alone.y[:, 0], together.y[:, seed], equal_nan=True)


def test_the_reference_does_not_depend_on_the_batch():
    game = Game.of("pinnobs/ModifiedAcademic-v0")
    alone, together = played(game, "open_loop")
    for seed, one in alone.items():
        expected = together.reference.by_sample[seed]
        assert one.reference.by_sample[0] == pytest.approx(expected, rel=1e-12)
