"""Rows told apart before they are compared."""

import pytest
from made_rows import rows_of

from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.distinct import distinct
from pinnobs_gym.leaderboard.standings_table import grid
from pinnobs_gym.scoring.rows import Stored

OLD, NEW = {"date": "2030-01-02"}, {"date": "2030-01-03"}


def names(rows):
    return [row["estimator"] for row in distinct(rows).rows]


def test_rows_that_agree_are_left_as_they_are():
    rows = [*rows_of("ekf", [1.0, 2.0]), *rows_of("ukf", [1.0])]
    assert distinct(rows) == (rows, ())


def test_only_the_newest_code_of_a_game_is_kept_and_the_rest_is_named():
    old = rows_of("ekf", [1.0, 1.0, 1.0], game_hash="aaaaaaaaaa", **OLD)
    new = rows_of("ekf", [2.0, 2.0], game_hash="bbbbbbbbbb", **NEW)
    elsewhere = rows_of("ekf", [3.0], condition="noise5", game_hash="cccccccccc", **OLD)
    kept, (note,) = distinct([*old, *new, *elsewhere])
    assert kept == [*new, *elsewhere]
    assert note.startswith(
        "3 episodes of pinnobs/X-v0, benchmark, nominal are left out: they are of"
    )
    assert "(hash aaaaaa) than those used last (bbbbbb)" in note


def test_names_have_the_settings_that_are_not_the_usual_ones():
    rows = [*rows_of("ekf", [1.0], settings={"gate": 0.9}), *rows_of("ekf", [1.0])]
    rows += rows_of("ekf", [1.0] * 9, settings={"gate": 0.9, "huber": 1.0}, **NEW)
    assert names(rows) == ["ekf (gate=0.9)", "ekf", *["ekf (gate=0.9, huber=1.0)"] * 9]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"options": {"gate": 0.9, "huber": None}}, "ekf (gate=0.9)"),
        ({"options": {"huber": None}}, "ekf (without gate)"),
        ({"estimator_code": "0123456789"}, "ekf (code 012345)"),
        (
            {"options": {"gate": 0.9, "huber": 1.0}, "estimator_code": "0123456789"},
            "ekf (gate=0.9, huber=1.0, code 012345)",
        ),
    ],
)
def test_of_one_name_the_one_used_last_keeps_it_and_others_say_what_differs(changes, expected):
    """As with labels, which stand for settings, or after an edit. The number of rows is nothing."""
    plain = {"options": {"gate": None, "huber": None}, **NEW}
    rows = [
        *rows_of("ekf", [1.0], **plain),
        *rows_of("ekf", [1.0] * 2, estimator_hash="other", **{**plain, **OLD, **changes}),
    ]
    assert names(rows) == ["ekf", expected, expected]


def test_code_that_is_used_again_is_the_present_one():
    """Of a game and of an estimator: edited, run, reverted, and run again from the file."""
    first = rows_of("ekf", [1.0], estimator_hash="old", estimator_code="0123456789", **OLD)
    edited = rows_of("ekf", [1.0], estimator_hash="new", estimator_code="abcdefghij", **NEW)
    assert names([*first, *edited]) == ["ekf (code 012345)", "ekf"]
    use = {**first[0], "kind": "use", "date": "2030-01-04"}
    renamed = [row["estimator"] for row in distinct([*first, *edited], [use]).rows]
    assert renamed == ["ekf", "ekf (code abcdef)"]
    first, edited = (
        rows_of("ekf", [1.0], game_hash=code, **date) for code, date in (("a", OLD), ("b", NEW))
    )
    use = {**first[0], "kind": "use", "date": "2030-01-04"}
    assert distinct([*first, *edited]).rows == edited
    kept, (note,) = distinct([*first, *edited], [use])
    assert kept == first
    assert "(hash b) than those used last (a)" in note


def test_training_settings_tell_apart_and_training_seeds_do_not():
    def trained(seed, width, **changes):
        config = {"seed": seed, "width": width, "budget": 9.0}
        facts = {"training": {"config": config}, "training_seed": seed}
        return rows_of("gain", [1.0, 1.0], estimator_hash=f"{seed}{width}", **facts, **changes)

    rows = [*trained(0, 8, **NEW), *trained(1, 8, **NEW), *trained(0, 16, **OLD)[:1]]
    assert names(rows) == ["gain"] * 4 + ["gain (width=16)"]


def test_what_still_looks_alike_is_named_by_its_hash():
    """As two instances whose code cannot be read, or that know another noise."""
    old = rows_of("mine", [1.0], estimator_hash="once0123", **OLD)
    new = rows_of("mine", [1.0], estimator_hash="once4567", **NEW)
    assert names([*old, *new]) == ["mine (run once01)", "mine"]


def test_no_two_lines_of_a_table_look_alike():
    """Settings, code, training seeds, training settings and hashes: each of them is seen."""
    rows = [
        *rows_of("ekf", [1.0] * 3, options={"gate": None}, **NEW),
        *rows_of("ekf", [1.0], options={"gate": 0.9}, settings={"gate": 0.9}, estimator_hash="a"),
        *rows_of("ekf", [1.0], options={"gate": None}, estimator_code="b", estimator_hash="b"),
        *rows_of("ekf", [1.0], options={"gate": None}, estimator_hash="c", **OLD),
    ]
    for seed in (0, 1):
        config = {"seed": seed, "width": 8}
        facts = {"training": {"config": config}, "training_seed": seed}
        rows += rows_of("gain", [1.0], estimator_hash=f"g{seed}", **facts)
    (table,) = board(Stored(rows, [])).main.tables
    lines = grid(table).only(["estimator", "episodes"]).lines
    assert len(lines) == 5
    assert dict(lines) == {
        "ekf": "3",
        "ekf (gate=0.9)": "1",
        "ekf (code b)": "1",
        "ekf (run c)": "1",
        "gain": "2 × 1",  # training seeds are one line
    }


def test_tuned_settings_differ_between_systems_but_not_in_one():
    """Of one system, those that were used last keep the name."""

    def tuned(noise, **changes):
        options = {"assumed_noise": noise}
        own = {"options": options, "estimator_hash": f"hash{noise}", "knows": ["tuned"], **changes}
        return rows_of("ekf, tuned", [1.0], **own)

    other = {"env_id": "pinnobs/Y-v0"}
    found = distinct([*tuned(0.1), *tuned(0.2, **other)]).rows
    assert [row["estimator"] for row in found] == ["ekf, tuned", "ekf, tuned"]
    found = distinct([*tuned(0.1, **NEW), *tuned(0.2), *tuned(0.2, **other)]).rows
    assert [row["estimator"] for row in found] == [
        "ekf, tuned",
        "ekf, tuned (run hash0.)",
        "ekf, tuned",
    ]
