"""The overview and the ranks, against cases computed by hand."""

import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import markdown
from pinnobs_gym.scoring.rows import Stored

MOTOR = {"env_id": "pinnobs/Motor-v0", "condition": "load_step"}
NOISY = np.exp(0.1 * np.random.default_rng(0).standard_normal((4, 60)))
"""Errors of four estimators about 1, independent."""


def main_part(rows):
    return board(Stored(rows, [])).main


def lines(rows):
    return {line.estimator: line for line in main_part(rows).lines}


def played():
    """Two systems, the second ranked under another condition; one estimator is twice as good as the
    peer on the first and eight times as good on the second."""
    return [
        *rows_of("ukf", NOISY[0]),
        *rows_of("ukf", 0.1 * NOISY[1], **MOTOR),
        *rows_of("half", NOISY[0] / 2),
        *rows_of("half", 0.1 * NOISY[1] / 8, **MOTOR),
        *rows_of("same", NOISY[2]),
        *rows_of("same", 0.1 * NOISY[3], **MOTOR),
        *rows_of("smooth", NOISY[0] / 4, track="offline"),
    ]


def test_the_factor_is_the_geometric_mean_over_systems():
    found = lines(played())
    assert next(iter(found)) == "half"
    assert {*found} == {"half", "ukf", "same", "smooth"}
    half = found["half"].places["steady"]
    assert half.factor.value == pytest.approx(1 / 4)
    assert half.factor.value == pytest.approx((half.factor.low + half.factor.high) / 2)
    assert half.rank == 1
    ukf, same = (found[name].places["steady"] for name in ("ukf", "same"))
    assert (ukf.factor.value, ukf.factor.low, ukf.factor.high) == (1, 1, 1)
    assert same.factor.low < 1 < same.factor.high
    assert (ukf.rank, same.rank) == (2, 2)  # nothing tells them apart
    assert found["smooth"].places["steady"].rank is None  # it did not play the motor
    assert found["smooth"].places["steady"].factor.value == pytest.approx(0.25)


def test_windows_are_ranked_by_themselves():
    rows = [*rows_of("ukf", NOISY[0]), *rows_of("slow", NOISY[0] / 2)]
    for row in rows:
        row["nrmse_transient"] = 3.0 if row["estimator"] == "slow" else 1.0
    slow = lines(rows)["slow"].places
    assert (slow["steady"].rank, slow["transient"].rank) == (1, 2)
    assert slow["transient"].factor.value == pytest.approx(3)


def test_a_diverged_episode_counts_as_an_error_of_the_whole_scale():
    lost = [i < 40 for i in range(60)]
    rows = [
        *rows_of("ukf", np.full(60, 0.1)),
        *rows_of("lost", np.full(60, 0.01), diverged=lost),
        *rows_of("gone", np.full(60, np.inf), diverged=[True] * 60),
    ]
    found = lines(rows)
    # of the log ratios -log 10 (20 times) and log 10 (40 times), 15 are trimmed at either end
    expected = np.log(10) * (25 - 5) / 30
    assert np.log(found["lost"].places["steady"].factor.value) == pytest.approx(expected)
    assert found["gone"].places["steady"].factor.value == pytest.approx(100)
    assert [found[name].places["steady"].rank for name in ("ukf", "lost", "gone")] == [1, 2, 3]


def test_training_seeds_are_a_level_of_their_own():
    """Two trainings, twice as good and twice as bad on every episode: 60 episodes of each tell
    nothing about the next training."""
    made = {"training": {"seconds": 1.0}}
    rows = [
        *rows_of("ukf", NOISY[0]),
        *rows_of("gain", NOISY[0] / 2, training_seed=0, estimator_hash="0", **made),
        *rows_of("gain", NOISY[0] * 2, training_seed=1, estimator_hash="1", **made),
    ]
    gain = lines(rows)["gain"]
    factor = gain.places["steady"].factor
    assert factor.value == pytest.approx(1)
    assert factor.low < 0.1 < 10 < factor.high
    assert gain.places["steady"].rank == 1
    assert next(iter(gain.games.values())).trainings == 2


def test_without_the_peer_the_first_online_estimator_stands_in():
    part = main_part([*rows_of("a", NOISY[0]), *rows_of("b", NOISY[0] / 2)])
    assert part.places.peer == "a"
    assert [line.estimator for line in part.lines] == ["b", "a"]
    assert main_part(rows_of("s", NOISY[0], track="offline")).places.peer == ""


def test_those_that_played_other_episodes_have_a_factor_but_no_rank():
    rows = [*rows_of("ukf", NOISY[0]), *rows_of("less", NOISY[0][:30] / 2)]
    place = lines(rows)["less"].places["steady"]
    assert place.factor.value == pytest.approx(0.5)
    assert place.rank is None


def test_ranks_under_conditions():
    outliers = {"condition": "outliers", "ranked": False}
    few = {"condition": "gap", "ranked": False}
    delayed = {"condition": "delay1", "ranked": False, "free_over_known": 12.0}
    rows = [*played()]
    for facts in (outliers, delayed):
        rows += [*rows_of("ukf", NOISY[0], **facts), *rows_of("half", NOISY[0] * 2, **facts)]
    rows += [*rows_of("ukf", NOISY[0][:9], **few), *rows_of("half", NOISY[1][:9] / 9, **few)]
    part = main_part(rows)
    assert list(part.conditions) == ["nominal", "load_step", "outliers", "delay1", "gap"]
    grid = ranks_table.rank_grid(part.conditions, part.knows)
    assert grid.header == ("estimator", "nominal", "load_step", "outliers", "worst", "knows")
    assert grid.lines == (
        ("half", "1", "1", "2", "2", "model"),
        ("ukf", "2", "2", "1", "2", "model"),
        ("same", "2", "2", "", "2", "model"),
    )
    assert grid.note == (
        "delay1: not identifiable on any system, so that nothing is ranked. "
        "gap: fewer than 50 episodes, which are not ranked."
    )


def test_a_system_whose_states_are_not_identifiable_is_left_out_of_a_condition():
    facts = {"condition": "delay1", "ranked": False}
    other = {"env_id": "pinnobs/Y-v0", "free_over_known": 6.0, **facts}
    rows = [*rows_of("ukf", NOISY[0], **facts), *rows_of("half", NOISY[0] / 2, **facts)]
    rows += [*rows_of("ukf", NOISY[0], **other), *rows_of("half", NOISY[0] * 90, **other)]
    rows += [*rows_of("ukf", NOISY[0]), *rows_of("half", NOISY[0])]
    part = main_part(rows)
    assert part.conditions["delay1"].rank("steady", "half") == 1
    assert "delay1: without Y-v0" in ranks_table.rank_grid(part.conditions, part.knows).note
    table = next(t for t in part.tables if t.game.system == "Y-v0")
    assert {entry.ranks["steady"] for entry in table.entries} == {None}
    assert "Not identifiable" in table.note
    assert "6 times" in table.note


def test_estimators_trained_on_each_record_are_compared_apart_on_their_episodes():
    made = {"training": {"per_record": True}, "track": "offline"}
    rows = [
        *rows_of("ukf", NOISY[0]),
        *rows_of("half", NOISY[0] / 2),
        *rows_of("pinn", NOISY[0][:5] / 3, **made),
    ]
    found = board(Stored(rows, []))
    assert [line.estimator for line in found.main.lines] == ["half", "ukf"]
    assert [line.estimator for line in found.on_record.lines] == ["half", "ukf", "pinn"]
    (table,) = found.on_record.tables
    assert {entry.standing.episodes for entry in table.entries} == {5}
    assert next(iter(found.main.tables[0].entries)).standing.episodes == 60
    text = markdown(found)
    assert "# Leaderboard, trained on each record" in text
    assert board(Stored(rows[:-5], [])).on_record is None


def test_markdown_has_who_knew_what_in_every_table():
    rows = played() + rows_of("ukf", NOISY[0], condition="outliers", ranked=False)
    text = markdown(board(Stored(rows, [])))
    headers = [line for line in text.splitlines() if line.startswith("| ") and "estimator" in line]
    assert len(headers) == 2 + 3  # the overview, the ranks and three games
    assert all("| knows |" in line for line in headers)
