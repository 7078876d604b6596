"""The overview and the ranks, against cases computed by hand."""

import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import ranks_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import ON_RECORD, markdown
from pinnobs_gym.leaderboard.intervals import Interval
from pinnobs_gym.leaderboard.places import FAR
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
    assert half.factor.low == pytest.approx(half.factor.high)  # on every episode
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


def test_the_peer_is_the_better_ukf_of_those_that_played_the_most():
    ukf, tuned = rows_of("ukf", NOISY[0]), rows_of("ukf, tuned", NOISY[0] / 2)
    part = main_part([*ukf, *tuned])
    assert part.places.peer == "ukf, tuned"
    found = {line.estimator: line.places["steady"].factor.value for line in part.lines}
    assert found == {"ukf": pytest.approx(2), "ukf, tuned": 1}
    assert main_part([*ukf, *tuned[:-1]]).places.peer == "ukf"
    worse = rows_of("ukf, tuned", NOISY[0] * 2)
    assert main_part([*ukf, *worse]).places.peer == "ukf"
    assert main_part([*ukf, *tuned, *rows_of("ukf", NOISY[1], **MOTOR)]).places.peer == "ukf"
    assert main_part([*tuned, *rows_of("a", NOISY[1])]).places.peer == "ukf, tuned"


def test_those_that_played_other_episodes_have_a_factor_but_no_rank():
    rows = [*rows_of("ukf", NOISY[0]), *rows_of("less", NOISY[0][:30] / 2)]
    place = lines(rows)["less"].places["steady"]
    assert place.factor.value == pytest.approx(0.5)
    assert place.rank is None


def test_ranks_under_conditions():
    outliers = {"condition": "outliers", "ranked": False}
    few = {"condition": "gap", "ranked": False}
    delayed = {
        "condition": "delay1",
        "ranked": False,
        "free_over_known": 12.0,
        "nominal_over_free": 1.1,
    }
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
    other = {"env_id": "pinnobs/Y-v0", "free_over_known": 6.0, "nominal_over_free": 1.2, **facts}
    rows = [*rows_of("ukf", NOISY[0], **facts), *rows_of("half", NOISY[0] / 2, **facts)]
    rows += [*rows_of("ukf", NOISY[0], **other), *rows_of("half", NOISY[0] * 90, **other)]
    rows += [*rows_of("ukf", NOISY[0]), *rows_of("half", NOISY[0])]
    part = main_part(rows)
    assert part.conditions["delay1"].rank("steady", "half") == 1
    assert "delay1: without Y-v0" in ranks_table.rank_grid(part.conditions, part.knows).note
    table = next(t for t in part.tables if t.game.system == "Y-v0")
    assert {entry.ranks["steady"] for entry in table.entries} == {None}
    assert table.note == (
        "Not identifiable, so that nothing is ranked: the outputs do not tell the states from what "
        "the condition changes. Not knowing it makes the smallest error that can be reached 6 "
        "times as large, and a filter that ignores the change has 1.2 times this error."
    )


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
    assert "above" not in ON_RECORD  # a terminal prints this part before the other
    assert "below" not in ON_RECORD
    assert board(Stored(rows[:-5], [])).on_record is None


def test_markdown_has_who_knew_what_in_every_table():
    rows = played() + rows_of("ukf", NOISY[0], condition="outliers", ranked=False)
    text = markdown(board(Stored(rows, [])))
    headers = [line for line in text.splitlines() if line.startswith("| ") and "estimator" in line]
    assert len(headers) == 2 + 3  # the overview, the ranks and three games
    assert all("| knows |" in line for line in headers)


def test_one_episode_in_another_setup_does_not_touch_ranks():
    """It counted as one more system, which hardly anyone had played."""
    paper = {"setup": "paper", "game_hash": "paper"}
    alone = board(Stored(played(), []))
    both = board(Stored([*rows_of("half", [0.1], **paper), *played()], []))
    assert (both.main.setup, alone.notes) == ("benchmark", ())
    assert both.main.lines == alone.main.lines
    assert both.main.places == alone.main.places
    assert both.main.conditions == alone.main.conditions
    assert both.notes == (
        "The overview and the ranks are of the setup benchmark; in the tables of their games "
        "only: paper.",
    )
    assert {table.game.setup for table in both.main.tables} == {"benchmark", "paper"}
    assert both.notes[0] in markdown(both)


def test_without_the_benchmark_the_setup_with_the_most_rows_is_compared():
    some = [*rows_of("ukf", NOISY[0][:9], setup="wide"), *rows_of("ukf", [0.1], setup="paper")]
    found = board(Stored(some, []))
    assert found.main.setup == "wide"
    assert [game.setup for game in found.main.lines[0].games] == ["wide"]
    assert found.notes[0].endswith("only: paper.")
    own = {"training": {"per_record": True}, "track": "offline", "setup": "paper"}
    found = board(Stored([*some, *rows_of("pinn", [0.1], **own)], []))
    assert found.on_record.setup == "paper"
    assert len(found.notes) == 1  # the second part has this setup only


def test_a_system_is_ranked_under_its_own_condition_with_any_number_of_episodes():
    few = [*rows_of("ukf", 0.1 * NOISY[0][:20], **MOTOR), *rows_of("half", NOISY[0][:20], **MOTOR)]
    part = main_part(few)
    assert [line.places["steady"].rank for line in part.lines] == [1, 2]
    assert not part.conditions["load_step"].too_few
    part = main_part([row | {"ranked": False} for row in few])
    assert part.conditions["load_step"].too_few
    assert part.conditions["load_step"].rank("steady", "ukf") is None


@pytest.mark.parametrize(
    ("episodes", "bounded", "rank"), [(1, False, 1), (5, False, 1), (6, True, 1), (7, True, 2)]
)
def test_there_is_no_interval_where_no_difference_could_be_significant(episodes, bounded, rank):
    """The sign test of k episodes gives at least 2 / 2^k: 0.062, 0.031 and 0.016 for five to seven.
    The interval is of 5 %, and either test behind a rank of 2.5 %."""
    worse = 1.5 * (1 + 0.01 * np.arange(episodes))  # about half as bad again on every episode
    part = main_part([*rows_of("ukf", np.ones(episodes)), *rows_of("worse", worse)])
    factor = part.places.place("steady", "worse").factor
    assert part.places.rank("steady", "worse") == rank
    assert (factor.low > 1 and factor.high < 3) == bounded
    cells = {line[1]: line[2] for line in ranks_table.grid(part.lines, part.places.peer).lines}
    assert cells["ukf"] == "1"
    assert cells["worse"].startswith(("1.5 (", "1.6 ("))
    assert cells["worse"].endswith("(0–∞)") != bounded
    same = main_part([*rows_of("ukf", np.ones(episodes)), *rows_of("same", np.ones(episodes))])
    known = Interval(1.0, 1.0, 1.0) if episodes > 1 else Interval(1.0, 0.0, np.inf)
    assert same.places.place("steady", "same").factor == known


def test_without_a_verdict_there_is_no_rank_far_from_the_best():
    """Three trainings of errors 1, 8 and 64 times the peer's cannot be told from it, and five
    episodes cannot be told apart at all."""
    made = {"training": {"config": {"budget": 45.0}}, "options": {}}
    trainings = [
        row
        for seed, factor in enumerate((1.0, 8.0, 64.0))
        for row in rows_of(
            "gain", factor * NOISY[1], training_seed=seed, estimator_hash=str(seed), **made
        )
    ]
    worse = rows_of("worse", 1.3 * NOISY[2])
    part = main_part([*rows_of("ukf", NOISY[0]), *worse, *trainings])
    gain = next(name for name in part.places.windows["steady"] if name.startswith("gain"))
    factor = part.places.place("steady", gain).factor
    assert factor.low < 1 < FAR < factor.value
    assert part.places.rank("steady", gain) is None
    assert part.places.rank("steady", "worse") == 2  # those without a rank do not count
    assert [line.estimator for line in part.lines] == ["ukf", "worse", gain]
    few = [*rows_of("ukf", np.ones(5)), *rows_of("near", np.full(5, FAR * 0.99))]
    part = main_part([*few, *rows_of("far", np.full(5, FAR * 1.01))])
    ranks = [part.places.rank("steady", name) for name in ("ukf", "near", "far")]
    assert ranks == [1, 1, None]


def test_without_a_peer_the_headings_name_none():
    part = main_part(rows_of("smooth", NOISY[0], track="offline"))
    header = ranks_table.grid(part.lines, part.places.peer).header
    assert header[2:5] == ("steady", "transient rank", "transient")
