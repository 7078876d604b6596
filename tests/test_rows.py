import json
import multiprocessing

import pytest

from pinnobs_gym import rows
from pinnobs_gym.metrics import OPTIONAL_SCORES, SCORES


def row(seed=0, **changes):
    scores = dict.fromkeys(SCORES, 0.5)
    names = dict.fromkeys(rows.KEY, "x")
    facts = {"diverged": False, "episode_seed": seed, "ranked": True, "nx": 2}
    base = {"schema": rows.SCHEMA, **names, **scores, **facts}
    return {**base, **changes}


def test_round_trip_keeps_infinity_as_valid_json(tmp_path):
    path = tmp_path / "deep" / "rows.jsonl"
    rows.append(path, [row(0, nrmse=float("inf"), diverged=True), row(1)])
    rows.append(path, [row(2)])

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    for line in path.read_text().splitlines():
        json.loads(line, parse_constant=refuse)
    back = rows.read(path)
    assert [r["episode_seed"] for r in back] == [0, 1, 2]
    assert back[0]["nrmse"] == float("inf")
    assert back[1]["nrmse"] == 0.5


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


def test_no_file_is_no_rows(tmp_path):
    assert rows.read(tmp_path / "none.jsonl") == []


def test_a_truncated_line_is_named_and_the_file_kept(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    whole = path.read_text()
    path.write_text(whole[:-30])
    with pytest.raises(ValueError, match="line 2, is cut off") as caught:
        rows.read(path)
    assert "\n" not in str(caught.value)
    assert path.read_text() == whole[:-30]


@pytest.mark.parametrize("cut", [1, 30])
def test_rows_appended_after_a_cut_begin_on_a_line_of_their_own(tmp_path, cut):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    path.write_text(path.read_text()[:-cut])
    rows.append(path, [row(2), row(3)])
    lines = path.read_text().splitlines()
    assert len(lines) == 4
    if cut == 1:  # only the line's end was missing
        assert [r["episode_seed"] for r in rows.read(path)] == [0, 1, 2, 3]
    else:
        with pytest.raises(ValueError, match="line 2, is cut off"):
            rows.read(path)
        path.write_text("\n".join([lines[0], *lines[2:]]) + "\n")  # as the error advises
        assert [r["episode_seed"] for r in rows.read(path)] == [0, 2, 3]


def test_another_schema_and_missing_fields_are_refused(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(schema=99)])
    with pytest.raises(ValueError, match="schema 99; expected 2: move the file"):
        rows.read(path)
    path.unlink()
    incomplete = row()
    del incomplete["nrmse"]
    rows.append(path, [incomplete])
    with pytest.raises(ValueError, match="a row without nrmse"):
        rows.read(path)


def test_equal_duplicates_count_once_and_contradictory_ones_are_an_error(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(0)])
    assert len(rows.read(path)) == 1
    rows.append(path, [row(0, nrmse=0.7)])
    with pytest.raises(ValueError, match="lines 1 and 3, give different scores"):
        rows.read(path)


def test_an_unwritable_place_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot write rows to"):
        rows.append(tmp_path / "file" / "rows.jsonl", [row()])


def _write(path, first):
    for i in range(50):
        rows.append(path, [row(first + i)])


def test_processes_may_share_a_file(tmp_path):
    path = tmp_path / "rows.jsonl"
    context = multiprocessing.get_context("spawn")
    workers = [context.Process(target=_write, args=(path, 100 * i)) for i in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    seeds = sorted(r["episode_seed"] for r in rows.read(path))
    assert seeds == sorted(100 * i + j for i in range(3) for j in range(50))
