import numpy as np
import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard import chapters, standings, standings_table, tables
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.numerals import number
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.scoring.rows import Stored


def tables_of(rows, failures=()):
    return tables.tables(contenders(runs_of(rows)), failures)


def test_estimators_are_ranked_within_their_track():
    rows = [
        *rows_of("worse", [0.3, 0.1, 0.2] * 20),
        *rows_of("better", [0.1, 0.05, 0.1] * 20),
        *rows_of("offline", [0.01, 0.01, 0.01] * 20, track="offline"),
        *rows_of("worst", [0.01, 0.01, 0.01] * 20, diverged=[True, True, False] * 20),
        *rows_of("told", [0.01] * 60, track="online, condition known"),
    ]
    (table,) = tables_of(rows)
    found = [(entry.name, entry.ranks["steady"]) for entry in table.entries]
    online = [("better", 1), ("worse", 2), ("worst", 3)]
    assert found == [*online, ("offline", 1), ("told", 1)]
    assert np.isinf(table.entries[2].standing.steady.value)
    assert table.entries[2].standing.diverged.value == pytest.approx(2 / 3)


def test_markdown_has_a_table_per_game_with_all_columns():
    text = chapters.markdown(board(Stored(rows_of("ekf", [0.1, 0.2, 0.3]), [])))
    lines = text.partition("# Each game")[2].splitlines()
    header = next(line for line in lines if line.startswith("| "))
    body = lines[lines.index(header) + 2]
    assert header.count("|") == body.count("|") == len(standings_table.COLUMNS) + 1
    assert "## pinnobs/X-v0, benchmark, nominal" in lines
    assert "ekf" in body
    assert "0.2" in body


def test_unequal_episodes_are_pointed_out():
    same = tables_of([*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1, 0.2])])
    assert same[0].note == ""
    uneven = tables_of([*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1])])
    assert "Not all online estimators" in uneven[0].note
    apart = [*rows_of("a", [0.1, 0.2]), *rows_of("b", [0.1], track="offline")]
    assert tables_of(apart)[0].note == ""


def test_training_is_told_in_the_row():
    facts = {"config": {"budget": 25.0}, "iterations": 1000, "seconds": 25.0}
    standing = standings.standing(rows_of("pinn", [0.1], training=facts))
    assert standing.training == "budget 25 s, 1000 iterations, 25 CPU s"
    once = standings.standing(rows_of("pinn", [0.1], training={"iterations": 1, "seconds": 1.0}))
    assert once.training == "1 iteration, 1 CPU s"


@pytest.mark.parametrize(
    ("played", "shown"), [((50, 50, 50), "3 × 50"), ((50, 50, 10), "110, 3 trainings"), ((9,), "9")]
)
def test_trainings_that_played_different_numbers_of_episodes_have_the_total(played, shown):
    rows = []
    for seed, episodes in enumerate(played):
        facts = {"training_seed": seed, "estimator_hash": str(seed), "training": {"seconds": 1.0}}
        rows += rows_of("gain", [0.1] * episodes, **facts)
    (table,) = tables_of(rows)
    grid = standings_table.grid(table)
    assert grid.only(["episodes"]).lines == ((shown,),)


def test_a_table_without_ranks_says_why():
    few = {"condition": "gap", "ranked": False}
    (table,) = tables_of(rows_of("ekf", [0.1] * 49, **few))
    assert table.note == (
        "Nothing is ranked: fewer than 50 episodes under a condition other than nominal and that "
        "which the system is ranked under."
    )
    (table,) = tables_of(rows_of("smooth", [0.1] * 60, track="offline"))
    assert table.note == (
        "Nothing is ranked: no online estimator was played, with which others are compared."
    )
    rows = rows_of("gain", [0.1] * 4)
    for i, row in enumerate(rows):  # two trainings, each on other episodes
        row |= {"training_seed": i // 2, "estimator_hash": str(i // 2), "training": {"seconds": 1}}
    (table,) = tables_of(rows)
    assert table.note == "Nothing is ranked: the trainings of gain have no episode in common."
    ranked = [rows_of("ekf", [0.1] * 50, **few), rows_of("ekf", [0.1], condition="load_step")]
    assert [table.note for rows in ranked for table in tables_of(rows)] == ["", ""]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.00123456, "0.00123"), (np.inf, "∞"), (1234.5, "1234"), (12.345, "12.3"), (0, "0")],
)
def test_numbers(value, text):
    assert number(value) == text


def test_optional_scores_are_shown_where_they_are(tmp_path):
    facts = {"reference_steady": 0.08, "anees": 1.5, "coverage": 0.876, "nis": 1.04}
    (table,) = tables_of([*rows_of("ekf", [0.1] * 50, **facts), *rows_of("bare", [0.2])])
    grid = standings_table.grid(table)
    ekf, bare = (dict(zip(grid.header, line, strict=True)) for line in grid.lines)
    # the band of 50 episodes and 2 states is 0.742 to 1.296
    assert (ekf["/ CRR"], ekf["ANEES"], ekf["covers %"], ekf["NIS"]) == (
        *("1.25", "1.5 ▲", "88", "1.04"),
    )
    assert {bare[name] for name in ("/ CRR", "ANEES", "covers %", "NIS", "corr.")} == {""}
    for anees, shown in ((1.29, "1.29"), (0.7, "0.7 ▼"), (np.inf, "∞ ▲")):
        (table,) = tables_of(rows_of("ekf", [0.1] * 50, anees=anees))
        assert shown in standings_table.grid(table).lines[0]


def test_what_failed_is_told_in_the_note_of_its_game():
    failure = {
        "env_id": "pinnobs/X-v0",
        "setup": "benchmark",
        "condition": "nominal",
        "estimator": "mine",
        "episode": "seed:3",
        "episodes": 1,
        "error": "RuntimeError: out of luck.",
    }
    other = failure | {"condition": "noise5", "episodes": 20}
    second, first = tables_of(rows_of("ekf", [0.1, 0.2]), [failure, other])
    assert first.note == "Failed: mine, seed:3: RuntimeError: out of luck."
    assert [entry.name for entry in first.entries] == ["ekf"]
    assert (second.game.condition, second.entries) == ("noise5", ())  # nothing else was played
    assert second.note == "Failed: mine, 20 episodes: RuntimeError: out of luck."
    text = chapters.markdown(board(Stored(rows_of("ekf", [0.1, 0.2]), [failure, other])))
    assert second.note in text


def test_the_ratio_to_the_reference_is_of_root_mean_squares():
    rows = rows_of("ekf", [3.0, 4.0, 99.0])
    for row, reference in zip(rows, (1.0, 2.0, None), strict=True):
        row["reference_steady"] = reference
    found = standings.standing(rows)
    assert found.over_reference == pytest.approx(5 / 5**0.5)
