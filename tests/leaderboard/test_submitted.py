"""Submitted estimates in tables: apart from all others, and without a cost."""

import numpy as np
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks_table, standings_table
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.ranks import lines
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.site.across import costs
from pinnobs_gym.leaderboard.site.method import commands
from pinnobs_gym.leaderboard.tables import tables

NOISE = np.random.default_rng(0).uniform(0.9, 1.1, 60)
SUBMITTED = {"track": "online, submitted", "knows": ["submitted", "model"], "us_per_step": None}
ROWS = [
    *rows_of("ukf", 0.1 * NOISE),
    *rows_of("ekf", 0.1 * NOISE[::-1] + 0.02, us_per_step=2.0),
    *rows_of("best", 0.01 * NOISE, **SUBMITTED),
    *rows_of("worst", 0.15 * NOISE, **SUBMITTED),
]


def column(grid, name):
    place = grid.header.index(name)
    return [line[place] for line in grid.lines]


def test_they_are_ranked_among_themselves_and_outrank_nobody():
    (table,) = tables(contenders(runs_of(ROWS)))
    grid = standings_table.grid(table)
    assert column(grid, "estimator") == ["ukf", "ekf", "best", "worst"]
    assert column(grid, "rank") == ["1", "2", "1", "2"]
    assert column(grid, "track") == ["online", "online", *["online, submitted"] * 2]
    assert column(grid, "µs/step") == ["1", "2", "", ""]
    assert grid.blocks == (2,)


def test_the_overview_and_the_charts_have_no_cost_of_them():
    found, places = lines(contenders(runs_of(ROWS)))
    grid = ranks_table.grid(found, places.peer)
    assert column(grid, "estimator") == ["ukf", "ekf", "best", "worst"]
    assert column(grid, "µs/step") == ["1", "2", "", ""]
    drawn = costs(found, dict.fromkeys(("ukf", "ekf", "best", "worst")))
    assert drawn["us"] == [1.0, 2.0, None, None]
    assert drawn["front"] == [True, False, False, False]


def test_no_command_here_makes_them():
    (command,) = commands(runs_of(ROWS))
    assert "--estimators ekf ukf --" in command
    assert commands(runs_of(ROWS[120:])) == []
