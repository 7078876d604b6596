"""The overview against cases computed by hand."""

import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks, ranks_table
from pinnobs_gym.leaderboard.board import board, markdown
from pinnobs_gym.leaderboard.contenders import contenders, label
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.scoring.rows import Stored


def lines(rows):
    return ranks.lines(contenders(runs_of(distinct(rows).rows)))


def placed(rows):
    return ranks.ranks(ranks.log_ratios(contenders(runs_of(rows))))


def played():
    """Two systems of four episodes each, the second ranked under another condition."""
    motor = {"env_id": "pinnobs/Motor-v0", "condition": "load_step"}
    lost = [True, False, False, False]
    return [
        *rows_of("ekf", [1.0, 1.0, 1.0, 1.0]),
        *rows_of("ekf", [0.1, 0.1, 0.1, 0.1], **motor),
        *rows_of("half", [0.5, 0.5, 0.5, 0.5]),
        *rows_of("half", [0.05, 0.05, 0.05, 0.05], diverged=lost, **motor),
        *rows_of("lost", [0.1, 0.1, 0.1, 0.1], diverged=[True] * 4),
        *rows_of("lost", [0.1, 0.1, 0.1, 0.2], **motor),
        *rows_of("smooth", [0.25, 0.25, 0.25, 0.25], track="offline"),
    ]


def test_lines_by_hand():
    found = lines(played())
    assert [line.estimator for line in found] == ["half", "ekf", "lost", "smooth"]
    half, ekf, lost, smooth = found
    # -log 2 seven times and one infinite, which is in the highest quarter
    assert half.ratio.value == pytest.approx(0.5)
    assert half.better.value == 7 / 8
    assert (ekf.ratio.value, ekf.ratio.low, ekf.ratio.high) == (1, 1, 1)
    assert ekf.better.value == 0.5
    # four infinite, three zero, one log 2: more than a quarter are infinite
    assert np.isposinf(lost.ratio.value)
    assert lost.better.value == 1.5 / 8
    assert smooth.ratio.value == pytest.approx(0.25)
    assert [label(game) for game in smooth.games] == ["X-v0"]


def test_cells_by_hand():
    grid = ranks_table.grid(lines(played()))
    shown = grid.lines
    columns = ["estimator", "track", "/ ekf", "better", "Motor-v0 (load_step)", "X-v0", "µs/step"]
    assert grid.header == (*columns, "knows")
    assert shown[0][4:6] == ("0.05, div 25 %", "0.5")
    assert shown[2][4:6] == ("0.1", "div 100 %")
    assert shown[3][4:6] == ("", "0.25")
    assert shown[0][3] == "88 %"
    text = markdown(board(Stored(played(), [])))
    assert "| half | online | 0.5 (0.5-∞) | 88 % | 0.05, div 25 % | 0.5 | 1 | model |" in text


def test_settings_and_budgets_are_told_apart_and_training_seeds_are_not():
    rows = [
        *rows_of("ekf", [0.5], options={"gate": 0.99}, estimator_hash="gated"),
        *rows_of("ekf", [1.0, 1.0]),
        *rows_of("gain", [0.5, 0.5], training={"config": {"budget": 9.0}}, training_seed=0),
        *rows_of("gain", [2.0, 2.0], training={"config": {"budget": 9.0}}, training_seed=1),
    ]
    found = {line.estimator: line for line in lines(rows)}
    assert set(found) == {"ekf", "ekf (gate=0.99)", "gain, 9 s"}
    assert found["ekf (gate=0.99)"].ratio.value == pytest.approx(0.5)


def test_training_seeds_are_resampled():
    rows = [
        *rows_of("ekf", [1.0] * 8),
        *rows_of("gain", [0.5] * 8, training={"seconds": 1.0}, training_seed=0),
        *rows_of("gain", [2.0] * 8, training={"seconds": 1.0}, training_seed=1),
    ]
    (gain,) = (line for line in lines(rows) if line.estimator == "gain")
    assert gain.ratio.value == pytest.approx(1)
    assert (gain.ratio.low, gain.ratio.high) == pytest.approx((0.5, 2.0))


def test_only_common_episodes_are_compared():
    rows = [*rows_of("ekf", [1.0, 1.0, 100.0]), *rows_of("other", [2.0, 2.0])]
    (other,) = (line for line in lines(rows) if line.estimator == "other")
    assert other.ratio.value == pytest.approx(2)
    (alone,) = lines(rows_of("other", [2.0, 2.0]))
    assert alone.ratio is None


def test_ranks_by_hand():
    outliers = {"condition": "outliers", "ranked": False}
    rows = [
        *played(),
        *rows_of("ekf", [1.0, 1.0], diverged=[True, True], **outliers),
        *rows_of("half", [0.7, 0.7], **outliers),
        *rows_of("lost", [0.1, 0.1], **outliers),
        *rows_of("smooth", [0.1, 0.1], track="offline", **outliers),
    ]
    found = placed(rows)
    assert list(found) == ["nominal", "load_step", "outliers"]
    assert found["nominal"] == {"ekf": 2, "half": 1, "lost": 3}
    assert found["load_step"] == {"ekf": 2, "half": 1, "lost": 2}
    # that both never diverged, where the EKF always did, makes them equal
    assert found["outliers"] == {"ekf": 3, "half": 1, "lost": 1}
    grid = ranks_table.rank_grid(found)
    assert grid.header == ("condition", "half", "lost", "ekf")
    assert grid.lines[-1] == ("worst", "1", "3", "3")


def test_estimators_that_played_less_have_no_rank():
    other = {"env_id": "pinnobs/Y-v0"}
    rows = [*rows_of("ekf", [1.0]), *rows_of("ekf", [1.0], **other), *rows_of("half", [0.5])]
    assert placed(rows) == {"nominal": {"ekf": 1}}
