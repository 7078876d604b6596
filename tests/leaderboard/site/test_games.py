"""The games that the page shows."""

from page_rows import row

from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site.games import games_of
from pinnobs_gym.leaderboard.tables import tables


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
