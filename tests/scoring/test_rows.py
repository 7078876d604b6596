import json
import multiprocessing
import re

import pytest
from damage import full_disk
from stored_rows import row, write_fifty

from pinnobs_gym.files import CannotWrite
from pinnobs_gym.scoring import row_format, rows
from pinnobs_gym.scoring.metrics import OPTIONAL_SCORES, SCORES


def concatenate(path, some):
    """Append rows without regard to what the file holds, as ``cat`` does."""
    with path.open("a") as file:
        for each in some:
            shown = {k: None if v == float("inf") else v for k, v in each.items()}
            file.write(json.dumps(shown) + "\n")


def test_round_trip_keeps_infinity_as_valid_json(tmp_path):
    path = tmp_path / "deep" / "rows.jsonl"
    rows.append(path, [row(0, nrmse=float("inf"), diverged=True), row(1)])
    rows.append(path, [row(2)])

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    for line in path.read_text().splitlines():
        json.loads(line, parse_constant=refuse)
    back = rows.read(path)
    assert [rows.seed_of(r) for r in back] == [0, 1, 2]
    assert back[0]["nrmse"] == float("inf")
    assert back[1]["nrmse"] == 0.5


def test_the_game_of_a_row_and_of_a_failure():
    game = rows.game_of(row(0) | {"env_id": "pinnobs/X-v0", "setup": "paper", "condition": "delay"})
    assert game == ("pinnobs/X-v0", "paper", "delay")
    assert (game.env_id, game.system) == ("pinnobs/X-v0", "X-v0")
    assert rows.game_of(dict(zip(row_format.JOB, "abcdefg", strict=True))) == ("a", "b", "c")


def test_optional_scores_are_absent_infinite_or_a_number(tmp_path):
    path = tmp_path / "rows.jsonl"
    optional = dict.fromkeys(OPTIONAL_SCORES)
    rows.append(path, [row(0, **{**optional, "anees": float("inf"), "nis": 1.5})])
    assert '"anees": null' in path.read_text()
    assert "coverage" not in path.read_text()
    (back,) = rows.read(path)
    assert back["anees"] == float("inf")
    assert back["nis"] == 1.5
    assert back["coverage"] is None


def test_the_precision_of_a_floor_is_absent_from_other_rows(tmp_path):
    path = tmp_path / "rows.jsonl"
    floor = {"estimator": "exact_bayes", "track": row_format.FLOOR, "effective_sample_size": 812.5}
    rows.append(path, [row(0, **floor), row(1)])
    exact, other = rows.read(path)
    assert (exact["effective_sample_size"], exact["monte_carlo"]) == (812.5, None)
    assert other["effective_sample_size"] is None
    assert path.read_text().count("effective_sample_size") == 1
    assert "monte_carlo" not in path.read_text()


def test_no_file_is_no_rows(tmp_path):
    assert rows.read(tmp_path / "none.jsonl") == []


@pytest.mark.parametrize("cut", [1, 2, 30, 300])
def test_a_half_line_at_the_end_is_left_out_and_cut_off_by_the_next_rows(tmp_path, cut):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    whole = path.read_bytes()
    assert len(whole) > 600  # the longest cut leaves the first line alone
    path.write_bytes(whole[:-cut])
    stored = rows.load(path)
    kept = [0, 1] if cut == 1 else [0]  # only the line's end was missing
    assert [rows.seed_of(r) for r in stored.rows] == kept
    assert path.read_bytes() == whole[:-cut]
    assert ("line 2, is cut off" in stored.warning) == (cut > 1)
    assert "\n" not in stored.warning
    rows.append(path, [row(2), row(3)])
    stored = rows.load(path)
    assert [rows.seed_of(r) for r in stored.rows] == [*kept, 2, 3]
    assert stored.warning == ""


def test_every_beginning_of_a_line_is_a_half_line(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0)])
    line = path.read_bytes()[:-1]
    for length in (*range(1, 16), *range(16, len(line), 25), len(line) - 1):
        path.write_bytes(line[:length])
        assert rows.load(path) == ([], [], rows.load(path).warning, [], {})
        rows.append(path, [row(1)])
        assert [rows.seed_of(r) for r in rows.read(path)] == [1]


@pytest.mark.parametrize("content", ["notes of mine", "\0\0\0", "[1, 2]"])
def test_what_is_no_row_is_named_and_never_deleted(tmp_path, content):
    path = tmp_path / "rows.jsonl"
    path.write_text(content)
    with pytest.raises(ValueError, match="line 1, is cut off or is not a row") as caught:
        rows.read(path)
    assert "\n" not in str(caught.value)
    rows.append(path, [row(0)])
    assert path.read_text().startswith(content + "\n")


def test_a_damaged_line_in_the_middle_is_an_error_that_names_it(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1), row(2)])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], lines[1][:-30], lines[2]]) + "\n")
    with pytest.raises(ValueError, match="line 2, is cut off"):
        rows.read(path)
    path.write_text("\n".join([lines[0], lines[2]]) + "\n")  # as the error advises
    assert [rows.seed_of(r) for r in rows.read(path)] == [0, 2]


def event(kind="failure", day=1, job="a", **changes):
    names = dict.fromkeys(row_format.JOB, "x") | {"episode": "seed:0", "episodes": 1}
    names |= {"job": job, "date": f"2026-01-{day:02d}"}
    error = {"error": "out of luck"} if kind == "failure" else {}
    return {"schema": row_format.SCHEMA, "kind": kind, **names, **error, **changes}


def test_failures_are_kept_apart_until_the_job_goes_well(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [event(job="a"), row(0), event(job="b"), event(job="a", error="again")])
    stored = rows.load(path)
    assert [rows.seed_of(r) for r in stored.rows] == [0]
    assert {r["job"]: r["error"] for r in stored.failures} == {"a": "again", "b": "out of luck"}
    rows.append(path, [event("recovery", day=2)])
    assert [r["job"] for r in rows.load(path).failures] == ["b"]
    rows.append(path, [event(day=3)])
    assert [r["job"] for r in rows.load(path).failures] == ["a", "b"]
    rows.append(path, [event("dance")])
    with pytest.raises(ValueError, match='line 7: a row of kind "dance"; expected score'):
        rows.load(path)


def test_a_clock_that_goes_back_keeps_no_failure_alive(tmp_path):
    path, other = tmp_path / "rows.jsonl", tmp_path / "other.jsonl"
    rows.append(path, [event(day=9), event(day=9, job="b")])
    rows.append(path, [event("recovery", day=3)])
    assert [r["job"] for r in rows.load(path).failures] == ["b"]
    rows.append(path, [event("recovery", day=4, job="b"), event(day=10)])
    assert [r["job"] for r in rows.load(path).failures] == ["a"]
    rows.append(other, [event("recovery", day=11)])
    for both in ((path, other), (other, path)):
        assert rows.load_all(both).failures == []


def test_files_are_merged_by_concatenation_in_any_order(tmp_path):
    here, there, both = (tmp_path / name for name in ("here", "there", "both"))
    rows.append(here, [row(0), event(day=1)])
    rows.append(there, [row(1), row(0), event("recovery", day=2)])
    for parts in ((here, there), (there, here)):
        both.write_bytes(b"".join(part.read_bytes() for part in parts))
        stored = rows.load(both)
        assert sorted(rows.seed_of(r) for r in stored.rows) == [0, 1]
        assert stored.failures == []


def test_another_schema_and_missing_fields_are_refused(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(schema=99)])
    with pytest.raises(ValueError, match="schema 99; expected 5: move the file"):
        rows.read(path)
    path.unlink()
    incomplete = row()
    del incomplete["nrmse"]
    rows.append(path, [incomplete])
    with pytest.raises(ValueError, match="a row without nrmse"):
        rows.read(path)


def test_equal_duplicates_count_once_and_contradictory_ones_are_an_error(tmp_path):
    path = tmp_path / "rows.jsonl"
    concatenate(path, [row(0), row(0), row(0, nrmse=0.5 * (1 + 1e-9), date="2031-01-02")])
    assert len(rows.read(path)) == 1
    lost = {"diverged": True}
    concatenate(path, [row(1, **lost, nrmse=1e30), row(1, **lost, nrmse=float("inf"))])
    assert len(rows.read(path)) == 2
    concatenate(path, [row(0, nrmse=0.5001)])
    with pytest.raises(ValueError, match="lines 1 and 6, give different scores"):
        rows.read(path)


SAME = {
    "another cost": {"us_per_step": 2.0, "batch": 7},
    "another machine": {"versions": {"python": "4"}, "date": "2031-01-02T03:04:05.678+00:00"},
    "another time of training": {"training": {"seconds": 9.0, "config": {"width": 8}}},
    "rounding": {"anees": 1.5 + 1e-9, "state_rmse": {"steady": {"x1": 0.25 + 1e-9}}},
}
OTHER = {
    "state_rmse": {"steady": {"x1": 0.26}},
    "anees": 1.6,
    "coverage": 0.5,
    "reference_steady": 0.1,
    "knows": ["model", "noise"],
    "ranked": False,
    "nx": 3,
    "track": "offline",
    "estimator_code": "y",
    "options": {"window": 6},
    "settings": {"window": 6},
    "training": {"seconds": 1.0, "config": {"width": 9}},
    "free_over_known": 2.0,
    "a field of later": 1,
}
WHOLE = {
    "anees": 1.5,
    "state_rmse": {"steady": {"x1": 0.25}},
    "training": {"seconds": 1.0, "config": {"width": 8}},
    "options": {"window": 5},
}


@pytest.mark.parametrize("changes", SAME.values(), ids=SAME)
def test_what_depends_on_machine_and_time_is_no_contradiction(tmp_path, changes):
    path = tmp_path / "rows.jsonl"
    concatenate(path, [row(0, **WHOLE), row(0, **WHOLE | changes)])
    assert len(rows.read(path)) == 1


@pytest.mark.parametrize("name", OTHER)
@pytest.mark.parametrize("turned", [False, True])
def test_rows_of_one_episode_that_differ_in_any_other_field_are_an_error(tmp_path, name, turned):
    both = [row(0, **WHOLE), row(0, **WHOLE | {name: OTHER[name]})]
    files = [tmp_path / "a.jsonl", tmp_path / "b.jsonl"]
    for path, one in zip(files, both[::-1] if turned else both, strict=True):
        concatenate(path, [one])
    with pytest.raises(ValueError, match=f"different scores of the same .* differs in {name};"):
        rows.load_all(files)
    files[0].write_bytes(b"".join(path.read_bytes() for path in files))
    with pytest.raises(ValueError, match=f"lines 1 and 2, give .* differs in {name}; delete"):
        rows.load(files[0])


def test_numbers_of_the_estimates_of_diverged_episodes_are_not_compared(tmp_path):
    lost = {"diverged": True, "anees": 1.0, "state_rmse": {"steady": {"x1": 1e9}}, "nx": 2}
    changes = {"anees": 2.0, "state_rmse": {"steady": {"x1": None}}, "nrmse": 3.0}
    path = tmp_path / "rows.jsonl"
    concatenate(path, [row(0, **lost), row(0, **lost | changes)])
    assert len(rows.read(path)) == 1
    for name, value in {"nx": 3, "knows": [], "state_rmse": {}, "track": "offline"}.items():
        path.unlink()
        concatenate(path, [row(0, **lost), row(0, **lost | {name: value})])
        with pytest.raises(ValueError, match=f"differs in {name};"):
            rows.load(path)


@pytest.mark.parametrize("blank", [b"", b"   ", b"\t", b"\r"])
def test_blank_lines_are_skipped(tmp_path, blank):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    first, second = path.read_bytes().splitlines()
    path.write_bytes(b"\n".join([blank, first, blank, blank, second, blank, blank]))
    stored = rows.load(path)
    assert [rows.seed_of(r) for r in stored.rows] == [0, 1]
    assert stored.warning == ""
    rows.append(path, [row(1), row(2)])
    assert [rows.seed_of(r) for r in rows.read(path)] == [0, 1, 2]
    path.write_bytes(path.read_bytes().replace(b'"nx": 2', b'"nx": 0', 1))
    with pytest.raises(ValueError, match="line 2: nx=0; expected"):  # blank lines are counted
        rows.load(path)


def use(day=1, **changes):
    names = ("env_id", "setup", "condition", "game_hash", "estimator", "estimator_hash")
    known = {"schema": row_format.SCHEMA, "kind": "use", **dict.fromkeys(names, "x")}
    return {**known, "date": f"2026-01-{day:02d}", **changes}


def test_uses_are_kept_apart_from_scores_and_failures(tmp_path):
    here, there = tmp_path / "here.jsonl", tmp_path / "there.jsonl"
    rows.append(here, [use(1), row(0), event()])
    rows.append(here, [row(0), use(1)])
    rows.append(there, [use(2), row(1)])
    stored = rows.load(here)
    assert stored.uses == [use(1), use(1)]
    assert (len(stored.rows), len(stored.failures)) == (1, 1)
    both = rows.load_all([here, there])
    assert both.uses == [use(1), use(1), use(2)]
    assert len(both.rows) == 2
    rows.append(here, [row(0, nrmse=0.7), use(3)], replace=True)
    assert [r["date"] for r in rows.load(here).uses] == ["2026-01-01", "2026-01-01", "2026-01-03"]
    incomplete = use()
    del incomplete["estimator_hash"]
    rows.append(there, [incomplete])
    with pytest.raises(ValueError, match="line 3: a row without estimator_hash"):
        rows.load(there)


def seeds_in(path):
    return [rows.seed_of(json.loads(line)) for line in path.read_text().splitlines()]


def test_an_episode_in_the_file_is_not_written_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1), row(0, nrmse=0.7)])
    rows.append(path, [row(1, nrmse=0.7), row(2), row(2, estimator="other")])
    assert seeds_in(path) == [0, 1, 2, 2]
    assert {r["nrmse"] for r in rows.read(path)} == {0.5}


def test_what_others_append_is_not_written_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0)])
    concatenate(path, [row(1), row(2, schema=99)])
    rows.append(path, [row(1), row(2)])  # a row of another schema is another row
    assert seeds_in(path) == [0, 1, 2, 2]
    path.write_text(path.read_text()[:-1])  # the last line lacks its newline, but is whole
    rows.append(path, [row(2), row(3)])
    assert seeds_in(path) == [0, 1, 2, 2, 3]


@pytest.mark.parametrize("kept", [[], [5], [5, 6, 7, 8]])
@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_was_replaced_or_cut_is_read_anew(tmp_path, kept, replaced):
    path, other = tmp_path / "rows.jsonl", tmp_path / "other"
    rows.append(path, [row(0), row(1)])
    concatenate(other, [row(i) for i in kept])
    if replaced:
        other.replace(path)
    else:
        path.write_bytes(other.read_bytes())  # in place: the same file with other content
    rows.append(path, [row(0), row(5)])
    assert seeds_in(path) == [*kept, 0, *([] if 5 in kept else [5])]


def test_a_deleted_file_is_written_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0)])
    path.unlink()
    rows.append(path, [row(0)])
    assert seeds_in(path) == [0]


def test_replaced_rows_are_known_afterwards(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    rows.append(path, [row(0, nrmse=0.7)], replace=True)
    rows.append(path, [row(0, nrmse=0.9)])
    assert {rows.seed_of(r): r["nrmse"] for r in rows.read(path)} == {0: 0.7, 1: 0.5}


def test_two_writers_of_the_same_episodes_write_each_once(tmp_path):
    path = tmp_path / "rows.jsonl"
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=write_fifty, args=(path, first)) for first in (0, 25)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert sorted(seeds_in(path)) == list(range(75))


def test_an_unwritable_place_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write rows to"):
        rows.append(tmp_path / "file" / "rows.jsonl", [row()])


def test_a_full_disk_leaves_no_half_line(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0)])
    before = path.read_bytes()
    with full_disk(len(before) + 100):
        for _ in range(2):
            with pytest.raises(CannotWrite, match="File too large; it is unchanged") as caught:
                rows.append(path, [row(1)])
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == before


def test_processes_may_share_a_file(tmp_path):
    path = tmp_path / "rows.jsonl"
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=write_fifty, args=(path, 100 * i)) for i in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    seeds = sorted(rows.seed_of(r) for r in rows.read(path))
    assert seeds == sorted(100 * i + j for i in range(3) for j in range(50))


_BIG = f'"seed:{2**63}"'
WRONG = {
    "nrmse": ("-1", '"a"', "true", "NaN", "[0.1]", '{"a": 1}'),
    "us_per_step": ("-1", '"a"'),
    "anees": ("-0.5", "[]"),
    "innovation_correlation": ("-1.5", '"a"'),
    "episode": ("-1", "1", "true", "null", '"1"', '"seed:-1"', '"seed:01"', '"seed:1.5"', _BIG),
    "nx": ("-1", '"2"', "0", f"1{'0' * 30}", "2.0"),
    "nrmse_tail": ("9", "null", "NaN", "0.2001"),
    "mse": ("Infinity", "-Infinity", "1e999", f"1{'0' * 400}"),
    "coverage": ("1.01", "null", "-0.1"),
    "training_seed": ("-1", "1.5", '"a"'),
    "diverged": ("1", "null", '"no"'),
    "ranked": ("0",),
    "estimator": ("1", "null", "[]", json.dumps("a" * 1001), '""', '" ekf"', '"ekf\\n"'),
    "env_id": ("null", "{}", '""'),
    "setup": ('" "',),
    "condition": ('"nominal "',),
    "track": ('""', '"\\tonline"'),
    "game_hash": ("null",),
    "date": (
        *("3", '""', '"later"', '"2030-13-02"', '"2030-02-30"', '"2030-1-2"', '"20300102"'),
        *('"2030-01-02 03:04"', '"2030-01-02T25:00:00"', '"2030-01-02T03:04:05+02:00"'),
    ),
    "knows": ('"model"', "[1]"),
    "options": ("[]", "null"),
    "settings": ("[]", "null", "1"),
    "training": ("[]",),
    "versions": ("1",),
    "batch": ("-1", "true", '"a"'),
    "nominal_over_free": ("-1",),
    "effective_sample_size": ("-1", "true"),
    "monte_carlo": ("-0.1", '"a"'),
    "free_over_known": ("-1", '"a"'),
    "state_rmse": ("1", "[]", "null"),
}


@pytest.mark.parametrize(("name", "value"), [(n, v) for n, vs in WRONG.items() for v in vs])
def test_a_wrong_value_is_named_with_its_file_line_and_field(tmp_path, name, value):
    path = tmp_path / "rows.jsonl"
    first, second = json.dumps(row(0)), json.dumps(row(1) | {name: "?"})
    path.write_text(f"{first}\n{second.replace(json.dumps('?'), value)}\n")
    with pytest.raises(ValueError, match=rf"rows.jsonl, line 2: {name}=.*; expected ") as caught:
        rows.load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


NESTED = {
    "training.config": ({"training": {"config": 3}}, {"training": {"config": None}}),
    "training.config.budget": tuple(
        {"training": {"config": {"budget": budget}}} for budget in (0, -1, "9", True, [], 10**400)
    ),
    "training.seconds": tuple({"training": {"seconds": s}} for s in (-1, None, "1", True, {})),
    "training.iterations": ({"training": {"iterations": -1}}, {"training": {"iterations": "3"}}),
    "training.loss": ({"training": {"loss": float("nan")}},),
    "options.gate": tuple({"options": {"gate": [1, g]}} for g in (float("inf"), -float("inf"))),
    "settings.a.b": ({"settings": {"a": {"b": float("nan")}}},),
    "state_rmse.steady": ({"state_rmse": {"steady": 1}},),
    "state_rmse.steady.x1": tuple({"state_rmse": {"steady": {"x1": v}}} for v in (-1, "a")),
}


@pytest.mark.parametrize(("place", "changes"), [(n, v) for n, vs in NESTED.items() for v in vs])
def test_a_wrong_value_in_an_object_is_named_with_its_place(tmp_path, place, changes):
    path = tmp_path / "rows.jsonl"
    path.write_text(f"{json.dumps(row(0))}\n{json.dumps(row(1) | changes)}\n")
    with pytest.raises(ValueError, match=rf"line 2: {re.escape(place)}=.*; expected ") as caught:
        rows.load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_trainings_that_can_be_are_read(tmp_path):
    path = tmp_path / "rows.jsonl"
    trainings = [
        {"config": {"budget": 45.0}, "seconds": 0, "iterations": 12},
        {"config": {"budget": None}, "seconds": 1.5},
        {"config": {}, "knows": ["inputs"]},
    ]
    rows.append(path, [row(i, training=one) for i, one in enumerate(trainings)])
    assert [r["training"] for r in rows.read(path)] == trainings


@pytest.mark.parametrize("tail", [0.2, 0.2001])
@pytest.mark.parametrize("diverged", [False, True])
def test_what_diverged_is_what_its_last_quarter_says(tmp_path, tail, diverged):
    """The limit itself does not count as diverged (`metrics.DIVERGED`)."""
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0, diverged=diverged, nrmse_tail=tail)])
    if diverged == (tail > 0.2):
        assert rows.read(path)[0]["nrmse_tail"] == tail
    else:
        with pytest.raises(ValueError, match=rf"nrmse_tail={tail}; expected .*{str(diverged)[1:]}"):
            rows.read(path)


@pytest.mark.parametrize("name", ["schema", "kind"])
@pytest.mark.parametrize("value", [[], {}, None, True, "a" * 2000, ["a" * 2000], float("nan")])
def test_a_wrong_schema_or_kind_is_one_short_line(tmp_path, name, value):
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(row(0) | {name: value}) + "\n")
    with pytest.raises(ValueError, match=rf"rows.jsonl, line 1: .*{name} .*; expected ") as caught:
        rows.load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_names_of_fields_are_shown_on_one_line_and_shortened(tmp_path):
    path = tmp_path / "rows.jsonl"
    states = {"steady": {"x\n" * 1000: -1}}
    path.write_text(json.dumps(row(0, state_rmse=states)) + "\n")
    with pytest.raises(ValueError, match=r"line 1: state_rmse\.steady\..*=-1; expected") as caught:
        rows.load(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_infinite_errors_of_states_are_written_as_null(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0, diverged=True, state_rmse={"steady": {"x1": float("inf")}})])
    assert "Infinity" not in path.read_text()
    assert rows.read(path)[0]["state_rmse"] == {"steady": {"x1": float("inf")}}


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (json.dumps(row(1))[:-1] + ', "mse": 1}', "line 2: mse is given twice; expected once"),
        (
            json.dumps(row(1) | {"options": {}}).replace(
                '"options": {}', '"options": {"a": 1, "a": 2}'
            ),
            "line 2: a is given twice; expected once",
        ),
        (
            json.dumps(row(1) | {"options": {"a": "?"}}).replace('"?"', "1e999"),
            "line 2: options.a=Infinity; expected a value that JSON has",
        ),
        (
            json.dumps(row(1) | {"nx": "?"}).replace('"?"', "1" * 5000),
            "a number of too many digits",
        ),
        ("[]", "JSON of a list; expected an object"),
        ("{'a': 1}", "Expecting property name enclosed in double quotes, column 2"),
    ],
)
def test_why_a_line_is_no_row(tmp_path, line, reason):
    path = tmp_path / "rows.jsonl"
    path.write_text(f"{json.dumps(row(0))}\n{line}\n{json.dumps(row(2))}\n")
    with pytest.raises(ValueError, match=re.escape(reason)):
        rows.load(path)


def test_a_text_with_what_looks_like_a_key_is_read(tmp_path):
    path = tmp_path / "rows.jsonl"
    path.write_text(json.dumps(row(0) | {"options": {"a": 'b": c', "d": [{"e": 1}]}}) + "\n")
    assert rows.read(path)[0]["options"]["d"] == [{"e": 1}]


def test_endless_nesting_is_no_row(tmp_path):
    path = tmp_path / "rows.jsonl"
    path.write_text(f"{json.dumps(row(0))}\n{'[' * 10**5}\n{json.dumps(row(1))}\n")
    with pytest.raises(ValueError, match="line 2, is cut off or is not a row"):
        rows.load(path)


def test_every_required_field_is_checked():
    scores = {*SCORES, "us_per_step"}
    for kind, needed in row_format.NEEDED.items():
        checked = {name for name, *_ in row_format.FIELDS[kind]}
        assert needed - checked - scores == set(), kind


def test_only_submitted_estimates_may_be_without_a_cost(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0, us_per_step=None, knows=["submitted", "model"])])
    assert rows.read(path)[0]["us_per_step"] is None
    rows.append(path, [row(1, us_per_step=None)])
    with pytest.raises(ValueError, match=r"rows.jsonl, line 2: a row without us_per_step"):
        rows.read(path)
