"""The leaderboard's tables as text of several widths."""

import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks_table, standings_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.grid import fitting
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
    consistent = {"anees": 1.5, "coverage": 0.876, "nis": 1.04, "reference_ratio": 1.25}
    rows = []
    for facts in SYSTEMS:
        lost = [facts is MOTOR] + [False] * 7
        rows += rows_of("ekf", [0.0412] * 8, diverged=lost, **facts, **consistent)
        rows += rows_of("kkl_pinn", [0.0206] * 8, **facts, **trained)
    return [*rows, *rows_of("rts_smoother", [0.0118] * 8, track="offline", **SYSTEMS[-1])]


def shown(layouts, width):
    return "\n\n".join(grid.text(width, HINT) for grid in fitting(layouts, width))


OVERVIEW_80 = """\
Across systems
estimator       track               / ekf  better  µs/step  knows
--------------  -------  ----------------  ------  -------  ------------------
kkl_pinn, 45 s  online      0.5 (0.5-0.5)   100 %        1  model, true states
ekf             online            1 (1-1)    50 %        1  model
--------------  -------  ----------------  ------  -------  ------------------
rts_smoother    offline  0.29 (0.29-0.29)   100 %        1  model

Academic-v0
estimator        NRMSE  diverged %  µs/step
--------------  ------  ----------  -------
kkl_pinn, 45 s  0.0206           0        1
ekf             0.0412           0        1

HarmonicOscillator-v0
estimator        NRMSE  diverged %  µs/step
--------------  ------  ----------  -------
kkl_pinn, 45 s  0.0206           0        1
ekf             0.0412           0        1

InductionMotor-v0 (load_step)
estimator        NRMSE  diverged %  µs/step
--------------  ------  ----------  -------
kkl_pinn, 45 s  0.0206           0        1
ekf             0.0412          12        1

ReverseDuffing-v0
estimator        NRMSE  diverged %  µs/step
--------------  ------  ----------  -------
kkl_pinn, 45 s  0.0206           0        1
ekf             0.0412           0        1
--------------  ------  ----------  -------
rts_smoother    0.0118           0        1"""
OVERVIEW_120 = """\
Across systems
estimator                  / ekf  Academic-v0  HarmonicOscillator-v0  InductionMotor-v0 (load_step)  ReverseDuffing-v0
--------------  ----------------  -----------  ---------------------  -----------------------------  -----------------
kkl_pinn, 45 s     0.5 (0.5-0.5)       0.0206                 0.0206                         0.0206             0.0206
ekf                      1 (1-1)       0.0412                 0.0412               0.0412, div 12 %             0.0412
--------------  ----------------  -----------  ---------------------  -----------------------------  -----------------
rts_smoother    0.29 (0.29-0.29)                                                                                0.0118
not shown at this width: track, better, µs/step, knows (leaderboard.md has all)"""  # noqa: E501
OVERVIEW_200 = """\
Across systems
estimator       track               / ekf  better  Academic-v0  HarmonicOscillator-v0  InductionMotor-v0 (load_step)  ReverseDuffing-v0  µs/step  knows
--------------  -------  ----------------  ------  -----------  ---------------------  -----------------------------  -----------------  -------  ------------------
kkl_pinn, 45 s  online      0.5 (0.5-0.5)   100 %       0.0206                 0.0206                         0.0206             0.0206        1  model, true states
ekf             online            1 (1-1)    50 %       0.0412                 0.0412               0.0412, div 12 %             0.0412        1  model
--------------  -------  ----------------  ------  -----------  ---------------------  -----------------------------  -----------------  -------  ------------------
rts_smoother    offline  0.29 (0.29-0.29)   100 %                                                                                0.0118        1  model"""  # noqa: E501
GAME_80 = """\
pinnobs/ReverseDuffing-v0, benchmark, nominal
rank  estimator       episodes  diverged %  settled s   NRMSE  tail NRMSE  ANEES
----  --------------  --------  ----------  ---------  ------  ----------  -----
   1  kkl_pinn, 45 s         8    0 (0-32)     0.0206  0.0206      0.0206
   2  ekf                    8    0 (0-32)     0.0412  0.0412      0.0412    1.5
----  --------------  --------  ----------  ---------  ------  ----------  -----
   1  rts_smoother           8    0 (0-32)     0.0118  0.0118      0.0118
not shown at this width: track, 90th pct., / CRR, tail / CRR, covers %, NIS,
corr., µs/step, knows, training (leaderboard.md has all)"""


@pytest.mark.parametrize(
    ("width", "expected"),
    [(80, OVERVIEW_80), (120, OVERVIEW_120), (200, OVERVIEW_200), (None, OVERVIEW_200)],
)
def test_the_overview_has_a_table_per_system_where_a_column_per_system_does_not_fit(
    width, expected
):
    results = board(Stored(played(), []))
    assert shown(ranks_table.layouts(results.lines), width) == expected


@pytest.mark.parametrize(
    ("width", "dropped"),
    [
        (
            120,
            {"tail / CRR", "NIS", "corr.", "µs/step", "knows", "training"},
        ),
        (200, {"training"}),
        (None, set()),
    ],
)
def test_the_table_of_a_game(width, dropped):
    *_, table = board(Stored(played(), [])).tables
    layouts = standings_table.layouts(table)
    assert shown(layouts, 80) == GAME_80
    lines = shown(layouts, width).splitlines()
    known = [name for name in layouts[0][0].header if name not in dropped]
    assert lines[1].split() == " ".join(known).split()
    assert bool(dropped) == lines[-1].startswith("not shown at this width: ")


def test_intervals_are_left_out_before_the_table_becomes_records():
    rows = rows_of("an estimator of some length", [0.0412 + i / 1e4 for i in range(20)])
    layouts = standings_table.layouts(board(Stored(rows, [])).tables[0])
    assert "0.0421 (0.042-0.043)" in shown(layouts, 95)
    assert "0.0421      0.0421" in shown(layouts, 70)
    assert "\n95 % intervals are not shown at this width.\n" in shown(layouts, 70)
    assert "tail NRMSE: 0.0421 (0.042-0.043)\n" in shown(layouts, 50)


RANKS_60 = """\
Ranks
estimator            worst  nominal  noise5
-------------------  -----  -------  ------
ekf                      2        1       2
kkl_pinn, 45 s           2        2       1
strong_tracking_ekf      3        3
not shown at this width: mismatch10+outliers, dropout10
(leaderboard.md has all)"""
RANKS = """\
Ranks
condition            ekf  kkl_pinn, 45 s  strong_tracking_ekf
-------------------  ---  --------------  -------------------
nominal                1               2                    3
noise5                 2               1
mismatch10+outliers    1               2                    3
dropout10              1               2                    3
-------------------  ---  --------------  -------------------
worst                  2               2                    3"""


def test_ranks_have_a_line_per_estimator_where_a_column_of_each_does_not_fit():
    same = {"ekf": 1, "kkl_pinn, 45 s": 2, "strong_tracking_ekf": 3}
    placed = dict.fromkeys(("nominal", "noise5", "mismatch10+outliers", "dropout10"), same)
    placed["noise5"] = {"ekf": 2, "kkl_pinn, 45 s": 1}
    layouts = ranks_table.rank_layouts(placed)
    assert shown(layouts, 60) == RANKS_60
    assert shown(layouts, 61) == shown(layouts, None) == RANKS
