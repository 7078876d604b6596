"""The leaderboard's tables as text of several widths."""

import re

import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks_table, standings_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import chapters
from pinnobs_gym.leaderboard.grid import fitting
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.places import Place, Places
from pinnobs_gym.scoring.rows import Stored

MOTOR = {"env_id": "pinnobs/InductionMotor-v0", "condition": "load_step"}
SYSTEMS = [{"env_id": f"pinnobs/{name}-v0"} for name in ("Academic", "HarmonicOscillator")] + [
    MOTOR,
    {"env_id": "pinnobs/ReverseDuffing-v0"},
]
HINT = "leaderboard.md has all"


def played():
    """Three estimators on four systems, of which the offline one plays the last only."""
    training = {"config": {"budget": 45.0}, "iterations": 700, "seconds": 45.02}
    trained = {"training": training, "training_seed": 0, "knows": ["model", "true states"]}
    consistent = {"anees": 1.5, "coverage": 0.876, "nis": 1.04, "reference_steady": 0.033}
    rows = []
    for facts in SYSTEMS:
        lost = [facts is MOTOR and i < 6 for i in range(60)]
        rows += rows_of("ekf", [0.0412] * 60, diverged=lost, **facts, **consistent)
        rows += rows_of("kkl_pinn", [0.0206] * 60, **facts, **trained)
    rows += rows_of("rts_smoother", [0.0118] * 60, track="offline", **SYSTEMS[-1])
    return [row | {"nrmse_transient": 10 * row["nrmse"]} for row in rows]


def shown(layouts, width):
    return "\n\n".join(grid.text(width, HINT) for grid in fitting(layouts, width))


GAMES = """\
Academic-v0
estimator       steady  transient  diverged %  µs/step  track   knows
--------------  ------  ---------  ----------  -------  ------  -----
kkl_pinn, 45 s  0.0206      0.206           0        1  online  ab
ekf             0.0412      0.412           0        1  online  a
knows: a model, b true states.

HarmonicOscillator-v0
estimator       steady  transient  diverged %  µs/step  track   knows
--------------  ------  ---------  ----------  -------  ------  -----
kkl_pinn, 45 s  0.0206      0.206           0        1  online  ab
ekf             0.0412      0.412           0        1  online  a
knows: a model, b true states.

InductionMotor-v0 (load_step)
estimator       steady  transient  diverged %  µs/step  track   knows
--------------  ------  ---------  ----------  -------  ------  -----
kkl_pinn, 45 s  0.0206      0.206           0        1  online  ab
ekf             0.0412      0.412          10        1  online  a
knows: a model, b true states.

ReverseDuffing-v0
estimator       steady  transient  diverged %  µs/step  track    knows
--------------  ------  ---------  ----------  -------  -------  -----
kkl_pinn, 45 s  0.0206      0.206           0        1  online   ab
ekf             0.0412      0.412           0        1  online   a
--------------  ------  ---------  ----------  -------  -------  -----
rts_smoother    0.0118      0.118           0        1  offline  a
knows: a model, b true states."""
OVERVIEW_80 = """\
Across systems
rank  estimator       steady / ekf  transient / ekf  diverged %  track    knows
----  --------------  ------------  ---------------  ----------  -------  -----
   1  kkl_pinn, 45 s           0.5              0.5           0  online   ab
   2  ekf                        1                1         2.5  online   a
----  --------------  ------------  ---------------  ----------  -------  -----
      rts_smoother            0.29             0.29           0  offline  a
knows: a model, b true states.
not shown at this width: transient rank, µs/step (leaderboard.md has all)"""
OVERVIEW_120 = """\
Across systems
rank  estimator       steady / ekf  transient rank  transient / ekf  diverged %  track    µs/step  knows
----  --------------  ------------  --------------  ---------------  ----------  -------  -------  -----
   1  kkl_pinn, 45 s           0.5               1              0.5           0  online         1  ab
   2  ekf                        1               2                1         2.5  online         1  a
----  --------------  ------------  --------------  ---------------  ----------  -------  -------  -----
      rts_smoother            0.29                             0.29           0  offline        1  a
knows: a model, b true states."""  # noqa: E501
OVERVIEW_200 = """\
Across systems
rank  estimator       steady / ekf  transient rank  transient / ekf  diverged %  Academic-v0  HarmonicOscillator-v0  InductionMotor-v0 (load_step)  ReverseDuffing-v0  track    knows
----  --------------  ------------  --------------  ---------------  ----------  -----------  ---------------------  -----------------------------  -----------------  -------  ------------------
   1  kkl_pinn, 45 s           0.5               1              0.5           0       0.0206                 0.0206                         0.0206             0.0206  online   model, true states
   2  ekf                        1               2                1         2.5       0.0412                 0.0412               0.0412, div 10 %             0.0412  online   model
----  --------------  ------------  --------------  ---------------  ----------  -----------  ---------------------  -----------------------------  -----------------  -------  ------------------
      rts_smoother            0.29                             0.29           0                                                                                0.0118  offline  model
not shown at this width: µs/step (leaderboard.md has all)"""  # noqa: E501
OVERVIEW = """\
Across systems
rank  estimator       steady / ekf  transient rank  transient / ekf  diverged %  Academic-v0  HarmonicOscillator-v0  InductionMotor-v0 (load_step)  ReverseDuffing-v0  track    µs/step  knows
----  --------------  ------------  --------------  ---------------  ----------  -----------  ---------------------  -----------------------------  -----------------  -------  -------  ------------------
   1  kkl_pinn, 45 s           0.5               1              0.5           0       0.0206                 0.0206                         0.0206             0.0206  online         1  model, true states
   2  ekf                        1               2                1         2.5       0.0412                 0.0412               0.0412, div 10 %             0.0412  online         1  model
----  --------------  ------------  --------------  ---------------  ----------  -----------  ---------------------  -----------------------------  -----------------  -------  -------  ------------------
      rts_smoother            0.29                             0.29           0                                                                                0.0118  offline        1  model"""  # noqa: E501
GAME_80 = """\
pinnobs/ReverseDuffing-v0, benchmark, nominal
rank  estimator       steady  transient  diverged %  track    knows
----  --------------  ------  ---------  ----------  -------  ------------------
   1  kkl_pinn, 45 s  0.0206      0.206     0 (0–6)  online   model, true states
   2  ekf             0.0412      0.412     0 (0–6)  online   model
----  --------------  ------  ---------  ----------  -------  ------------------
   1  rts_smoother    0.0118      0.118     0 (0–6)  offline  model
not shown at this width: / Bayes, transient rank, transient / Bayes, settled s,
episodes, / CRR, ANEES, covers %, 90th pct., first, whole, last 75 %, last 25 %,
NIS, corr., µs/step, training (leaderboard.md has all)"""
GAME_120 = """\
pinnobs/ReverseDuffing-v0, benchmark, nominal
rank  estimator       steady  transient rank  transient  diverged %  settled s  track    episodes  knows
----  --------------  ------  --------------  ---------  ----------  ---------  -------  --------  ------------------
   1  kkl_pinn, 45 s  0.0206               1      0.206     0 (0–6)     0.0206  online         60  model, true states
   2  ekf             0.0412               2      0.412     0 (0–6)     0.0412  online         60  model
----  --------------  ------  --------------  ---------  ----------  ---------  -------  --------  ------------------
   1  rts_smoother    0.0118               1      0.118     0 (0–6)     0.0118  offline        60  model
not shown at this width: / Bayes, transient / Bayes, / CRR, ANEES, covers %, 90th pct., first, whole, last 75 %,
last 25 %, NIS, corr., µs/step, training (leaderboard.md has all)"""  # noqa: E501
GAME_200 = """\
pinnobs/ReverseDuffing-v0, benchmark, nominal
rank  estimator       steady  transient rank  transient  diverged %  settled s  track    episodes  / CRR  ANEES  covers %  90th pct.   first   whole  last 75 %   NIS  µs/step  knows
----  --------------  ------  --------------  ---------  ----------  ---------  -------  --------  -----  -----  --------  ---------  ------  ------  ---------  ----  -------  ------------------
   1  kkl_pinn, 45 s  0.0206               1      0.206     0 (0–6)     0.0206  online         60                             0.0206  0.0206  0.0206     0.0206              1  model, true states
   2  ekf             0.0412               2      0.412     0 (0–6)     0.0412  online         60   1.25  1.5 ▲        88     0.0412  0.0412  0.0412     0.0412  1.04        1  model
----  --------------  ------  --------------  ---------  ----------  ---------  -------  --------  -----  -----  --------  ---------  ------  ------  ---------  ----  -------  ------------------
   1  rts_smoother    0.0118               1      0.118     0 (0–6)     0.0118  offline        60                             0.0118  0.0118  0.0118     0.0118              1  model
not shown at this width: / Bayes, transient / Bayes, last 25 %, corr., training (leaderboard.md has all)"""  # noqa: E501
GAME = """\
pinnobs/ReverseDuffing-v0, benchmark, nominal
rank  estimator       steady  / Bayes  transient rank  transient  transient / Bayes  diverged %  settled s  track    episodes  / CRR  ANEES  covers %  90th pct.   first   whole  last 75 %  last 25 %   NIS  corr.  µs/step  knows               training
----  --------------  ------  -------  --------------  ---------  -----------------  ----------  ---------  -------  --------  -----  -----  --------  ---------  ------  ------  ---------  ---------  ----  -----  -------  ------------------  ----------------------------------------
   1  kkl_pinn, 45 s  0.0206                        1      0.206                        0 (0–6)     0.0206  online         60                             0.0206  0.0206  0.0206     0.0206     0.0206                     1  model, true states  budget 45 s, 700 iterations, 45.02 CPU s
   2  ekf             0.0412                        2      0.412                        0 (0–6)     0.0412  online         60   1.25  1.5 ▲        88     0.0412  0.0412  0.0412     0.0412     0.0412  1.04               1  model
----  --------------  ------  -------  --------------  ---------  -----------------  ----------  ---------  -------  --------  -----  -----  --------  ---------  ------  ------  ---------  ---------  ----  -----  -------  ------------------  ----------------------------------------
   1  rts_smoother    0.0118                        1      0.118                        0 (0–6)     0.0118  offline        60                             0.0118  0.0118  0.0118     0.0118     0.0118                     1  model"""  # noqa: E501


@pytest.fixture(scope="module")
def part():
    return board(Stored(played(), [])).main


@pytest.mark.parametrize(
    ("width", "expected"),
    [
        (80, f"{OVERVIEW_80}\n\n{GAMES}"),
        (120, f"{OVERVIEW_120}\n\n{GAMES}"),
        (200, OVERVIEW_200),
        (None, OVERVIEW),
    ],
)
def test_the_overview_has_a_table_per_system_where_a_column_per_system_does_not_fit(
    part, width, expected
):
    assert shown(ranks_table.layouts(part.lines, part.places.peer), width) == expected


@pytest.mark.parametrize(
    ("width", "expected"), [(80, GAME_80), (120, GAME_120), (200, GAME_200), (None, GAME)]
)
def test_the_table_of_a_game(part, width, expected):
    assert shown(standings_table.layouts(part.tables[-1]), width) == expected


RECORD = """\
rank:              1
estimator:         an estimator of some length
steady:            0.0421 (0.042–0.043)
transient rank:    1
transient:         0.0421 (0.042–0.043)
diverged %:        0 (0–16)
"""


def test_intervals_are_left_out_before_the_table_becomes_records():
    rows = rows_of("an estimator of some length", [0.0412 + i / 1e4 for i in range(20)])
    layouts = standings_table.layouts(board(Stored(rows, [])).main.tables[0])
    assert "0.0421 (0.042–0.043)" in shown(layouts, 105)
    assert "  0.0421     0.0421 " in shown(layouts, 75)
    assert "\nknows: a model. 95 % intervals are not shown at this width.\n" in shown(layouts, 75)
    assert RECORD in shown(layouts, 40)
    assert shown(layouts, 40).endswith("\nknows:             model")


RANKS_80 = """\
Ranks
estimator            nominal  noise5  noise10  outliers  dropout10  worst  knows
-------------------  -------  ------  -------  --------  ---------  -----  -----
ekf                        1       2        1         1          1      2  a
kkl_pinn, 45 s             2       1        2         2          2      2  ab
strong_tracking_ekf        3                3         3          3      3  a
knows: a model, b true states.

Ranks
estimator            gap  mismatch10  worst  knows
-------------------  ---  ----------  -----  -----
ekf                    1           1      2  a
kkl_pinn, 45 s         2           2      2  ab
strong_tracking_ekf    3           3      3  a
knows: a model, b true states. delay: fewer than 50 episodes, which are not
ranked."""
RANKS = """\
Ranks
estimator            nominal  noise5  noise10  outliers  dropout10  gap  mismatch10  worst  knows
-------------------  -------  ------  -------  --------  ---------  ---  ----------  -----  ------------------
ekf                        1       2        1         1          1    1           1      2  model
kkl_pinn, 45 s             2       1        2         2          2    2           2      2  model, true states
strong_tracking_ekf        3                3         3          3    3           3      3  model
delay: fewer than 50 episodes, which are not ranked."""  # noqa: E501


def placed(**ranks):
    """Places of these ranks."""
    steady = {name: Place(Interval(1.0, 1.0, 1.0), rank) for name, rank in ranks.items()}
    return Places("ekf", {"steady": steady})


def test_ranks_are_in_parts_of_five_conditions_where_all_do_not_fit():
    trained, robust = "kkl_pinn, 45 s", "strong_tracking_ekf"
    names = ("nominal", "noise5", "noise10", "outliers", "dropout10", "gap", "mismatch10")
    found = dict.fromkeys(names, placed(**{"ekf": 1, trained: 2, robust: 3}))
    found["noise5"] = placed(**{"ekf": 2, trained: 1})
    found["delay"] = Places("ekf", too_few=True)
    knows = {"ekf": ("model",), trained: ("model", "true states"), robust: ("model",)}
    layouts = ranks_table.rank_layouts(found, knows)
    assert shown(layouts, 80) == RANKS_80
    assert shown(layouts, 110) == RANKS
    assert shown(layouts, None) == RANKS


def test_where_no_condition_is_ranked_the_ranks_say_why():
    layouts = ranks_table.rank_layouts({"delay": Places("ekf", too_few=True)}, {})
    for width in (20, 80, None):
        assert "delay: fewer than 50" in " ".join(shown(layouts, width).split())


@pytest.mark.parametrize(
    ("width", "lettered"), [(50, True), (80, True), (120, True), (200, False), (None, False)]
)
def test_every_table_says_what_each_estimator_knows(width, lettered):
    """In words, or in letters with a legend below the same table; also in the second part."""
    rows = played()
    for condition in ("nominal", "outliers", "gap"):
        facts = {"condition": condition, "ranked": False, "env_id": "pinnobs/Y-v0"}
        rows += rows_of("ekf", [0.1] * 60, **facts)
    own = {"training": {"per_record": True}, "track": "offline", "knows": ["true states"]}
    rows += rows_of("pinn (guided by a smoother)", [0.1] * 2, **own, **SYSTEMS[0])
    whole = board(Stored(rows, []))
    known = {name: facts for part in whole.parts for name, facts in part.knows.items()}
    tables = [layouts for chapter in chapters(whole) for layouts in chapter.tables]
    assert len(tables) == (1 + 1 + 7) + (1 + 1)  # overviews, ranks, games
    legends = []
    for grid in (grid for layouts in tables for grid in fitting(layouts, width)):
        column = next(column for column in grid.columns if column.name == "knows")
        assert column.priority == 0
        legend = dict(re.findall(r"\b([a-z]) (model|true states)\b", grid.note))
        for line in grid.only(["estimator", "knows"]).lines:
            name, text = line
            words = [legend[letter] for letter in text] if legend else text.split(", ")
            assert tuple(words) == known[name]
        legends.append(legend)
    assert any(legends) == lettered
