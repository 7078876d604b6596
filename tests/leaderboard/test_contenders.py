"""Rows as runs and contenders, against cases worked out by hand."""

import numpy as np
from made_rows import rows_of

from pinnobs_gym.envs.game import GameName
from pinnobs_gym.leaderboard.contenders import among, contenders, label
from pinnobs_gym.leaderboard.runs import runs_of

X = GameName("pinnobs/X-v0", "benchmark", "nominal")


def test_runs_are_in_the_order_of_their_first_rows():
    a, b = rows_of("a", [0.1, 0.2]), rows_of("b", [0.3], condition="delay")
    runs = runs_of([a[0], *b, a[1]])
    assert [(run.estimator, run.position, len(run.rows)) for run in runs] == [
        ("a", 0, 2),
        ("b", 1, 1),
    ]
    assert [run.game for run in runs] == [X, X._replace(condition="delay")]
    assert runs[0].standing.steady.value == np.median([0.1, 0.2])
    assert runs[0].standing is runs[0].standing


def test_labels_leave_out_what_is_usual():
    assert label(X) == "X-v0"
    assert label(X._replace(condition="delay")) == "X-v0 (delay)"
    assert label(X._replace(condition="delay", setup="paper")) == "X-v0 (delay), paper"


def test_errors_are_of_the_episodes_that_all_trainings_played():
    made = {"training": {"seconds": 1.0}}
    rows = [
        *rows_of("gain", [0.5, 4.0], training_seed=0, estimator_hash="g0", **made),
        *rows_of("gain", [0.25, 1.0, 1.0], training_seed=1, estimator_hash="g1", **made),
        *rows_of("gain", [9.0], condition="delay", training_seed=0, estimator_hash="g0", **made),
        *rows_of("ukf", [20.0, 0.1, 0.1], diverged=[False, True, False]),
    ]
    gain, ukf = contenders(runs_of(rows))
    assert (gain.name, ukf.name) == ("gain", "ukf")  # the most rows first
    assert list(gain.games) == [X._replace(condition="delay"), X][::-1]
    assert gain.errors[X].episodes == ("seed:0", "seed:1")
    np.testing.assert_allclose(np.exp(gain.errors[X].logs["steady"]), [[0.5, 4.0], [0.25, 1.0]])
    assert gain.standing(X).episodes == 3
    # errors are at most ten times the scale, and those of diverged episodes at least the scale
    np.testing.assert_allclose(np.exp(ukf.errors[X].logs["steady"]), [[10.0, 1.0, 0.1]])
    some = ukf.errors[X].of(["seed:2", "seed:1"])
    np.testing.assert_allclose(np.exp(some.logs["steady"]), [[0.1, 1.0]])
    assert some.diverged.tolist() == [[False, True]]


def test_among_wanted_games_the_order_is_of_their_rows_alone():
    rows = [*rows_of("a", [0.1] * 3), *rows_of("b", [0.1] * 2), *rows_of("c", [0.1] * 2)]
    rows += [*rows_of("c", [0.1] * 2, condition="delay"), *rows_of("b", [0.1], condition="delay")]
    found = contenders(runs_of(rows))
    assert [each.name for each in found] == ["c", "a", "b"]
    delayed = among(found, lambda run: run.game.condition == "delay")
    assert [each.name for each in delayed] == ["c", "b"]
    nominal = among(found, lambda run: run.game.condition == "nominal")
    assert [each.name for each in nominal] == ["a", "b", "c"]
