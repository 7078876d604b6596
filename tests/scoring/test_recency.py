"""Which code was used last."""

import pytest
from made_rows import rows_of

from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.evaluation import evaluate
from pinnobs_gym.scoring.provenance import now
from pinnobs_gym.scoring.recency import LastUse

OLD, NEW, NEWEST = ({"date": f"2030-01-0{day}"} for day in (2, 3, 4))


def seed(number, **changes):
    facts = {"training": {"config": {"seed": number, "width": 8}}, "training_seed": number}
    return rows_of("gain", [1.0], estimator_hash=f"g{number}", **facts, **changes)


@pytest.mark.parametrize(
    ("others", "last"),
    [
        ([], True),
        (rows_of("ukf", [1.0], estimator_code="other", **NEW), True),  # another estimator
        (rows_of("ekf", [1.0], estimator_hash="b", settings={"gate": 0.9}, **NEW), True),
        (rows_of("ekf", [1.0], condition="gap", game_hash="x", **NEW), True),  # another game
        (rows_of("ekf", [1.0], estimator_hash="b", estimator_code="edited", **NEW), False),
        (rows_of("ekf", [1.0], estimator_hash="b", options={"gate": 0.9}, **NEW), False),  # a label
        (rows_of("ukf", [1.0], game_hash="edited", **NEW), False),
    ],
)
def test_only_other_code_that_was_used_later_counts(others, last):
    (row,) = rows_of("ekf", [1.0], **OLD)
    assert LastUse.of([row, *others]).is_last(row) == last
    use = {**row, "kind": "use", **NEWEST}
    assert LastUse.of([row, *others, use]).is_last(row)


def test_training_seeds_are_one_estimator():
    """Of three trainings that are taken from a file, none is said to be the present code again."""
    rows = [*seed(0, **OLD), *seed(1, **NEW), *seed(2, **NEWEST)]
    last_use = LastUse.of(rows)
    assert all(last_use.is_last(row) for row in rows)
    edited = seed(1, estimator_code="edited", **NEWEST)
    edited[0]["estimator_hash"] = "e1"
    assert not LastUse.of([*rows[:2], *edited]).is_last(rows[0])


def test_a_clock_that_goes_back_does_not_make_old_code_the_present_one(tmp_path):
    path = tmp_path / "rows.jsonl"
    evaluate("ekf", "ReverseDuffing", episodes=1, results=path)
    (old,) = rows_module.read(path)
    future = {**old, "game_hash": "edited", "date": "2999-01-01T00:00:00.000+00:00"}
    rows_module.append(path, [future])
    for episodes in (2, 2):  # played, then taken from the file
        evaluate("ekf", "ReverseDuffing", episodes=episodes, results=path)
        stored = rows_module.load(path)
        assert LastUse.of([*stored.rows, *stored.uses]).is_last(old)
        assert [use["date"] for use in stored.uses] == ["2999-01-01T00:00:00.001+00:00"]


def test_a_date_is_later_than_another():
    assert now() < now("2999-12-31") == "2999-12-31T00:00:00.001+00:00"
    assert now("2000-01-01") > "2026"
