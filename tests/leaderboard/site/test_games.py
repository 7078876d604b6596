"""The games that the page shows."""

import numpy as np
from page_rows import curves, lines_of, row

from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.floor import floors
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site.games import games_of
from pinnobs_gym.leaderboard.tables import tables
from pinnobs_gym.scoring.curves import save
from pinnobs_gym.scoring.row_format import FLOOR, FLOOR_WHOLE


def test_games_are_the_ranked_one_and_then_the_nominal_one():
    group = [row(condition=c, ranked=c == "load_step") for c in ("nominal", "load_step", "noise5")]
    players = contenders(runs_of(group))
    made = tables(players)
    games = games_of(players, made, [])
    assert [each.game.condition for each in games] == ["load_step", "nominal"]
    assert [each.table for each in games] == [made[0], made[2]]  # load_step, noise5, nominal
    assert [each.number for each in games] == [0, 1]
    assert games[0].states is None
    assert games[0].errors["t"] == []


def floors_of(group):
    """Two floors of three of the episodes: filtered, and given the whole record."""
    names = {FLOOR: "exact_bayes", FLOOR_WHOLE: "exact_bayes_smoother"}
    return [
        row(seed, estimator=name, estimator_hash=name, track=track, settling=0.5 + seed)
        for track, name in names.items()
        for seed in range(len(group) + 1)
    ]


def test_a_game_has_the_curves_of_its_floors(tmp_path):
    group = [row(seed, settling=1.0) for seed in range(3)]
    made = floors_of(group)
    for each in (group[0], made[0], made[4]):
        level = 0.25 if each["track"] == FLOOR else 0.125
        error = np.full((4, 3), 1.0 if each in group else level)
        save(tmp_path, each, curves(error))
    found = floors([*group, *made])
    players = contenders(runs_of(group, found))
    (game,) = games_of(players, tables(players, (), found), [tmp_path], found)
    assert set(game.errors["estimator"]) == {"ekf"}
    whole = "exact Bayes, whole record"
    assert lines_of(game.floor_errors, "exact Bayes") == [(t, *[0.25] * 3) for t in (0, 1, 2)]
    assert lines_of(game.floor_errors, whole) == [(t, *[0.125] * 3) for t in (0, 1, 2)]
    # Of the three episodes that were played.
    assert lines_of(game.floor_settling, whole)[-2:] == [(2.5, 1.0), (2.5, 1.0)]
    assert game.over_floor["estimator"] == []  # too few episodes
    assert game.states.estimates["estimator"][0] == "ekf"


def test_errors_over_the_floor_are_drawn_by_their_steady_ratio():
    group = [
        row(k, estimator=n, estimator_hash=n, nrmse_steady_modulo=e, nrmse_transient=0.3)
        for n, e in (("ekf", 0.4), ("ukf", 0.2))
        for k in range(12)
    ]
    found = floors(
        [
            *group,
            *(
                each | {"track": FLOOR, "estimator": "exact_bayes"}
                for each in (row(k) for k in range(12))
            ),
        ]
    )
    players = contenders(runs_of(group, found))
    (game,) = games_of(players, tables(players, (), found), [], found)
    drawn = list(zip(*(game.over_floor[n] for n in ("estimator", "window", "ratio")), strict=True))
    assert drawn == [
        ("ukf", "steady", 2.0),
        ("ukf", "transient", 3.0),
        ("ekf", "steady", 4.0),
        ("ekf", "transient", 3.0),
    ]
