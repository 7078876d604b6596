import json
import math
import sys

import pytest
from stored_rows import row

from pinnobs_gym import evaluate, read_rows
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.table import Rows


def test_a_file_is_read_with_each_episode_once(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0, nrmse=math.inf, diverged=True), row(1)])
    path.write_bytes(path.read_bytes() * 2)
    read = read_rows(str(path))
    assert isinstance(read, Rows)
    assert [(r["episode"], r["nrmse"]) for r in read] == [("seed:0", math.inf), ("seed:1", 0.5)]


def test_what_cannot_be_read_is_one_clear_line(tmp_path):
    with pytest.raises(ValueError, match=r"there is no rows file .*none\.jsonl"):
        read_rows(tmp_path / "none.jsonl")
    one, other = tmp_path / "one.jsonl", tmp_path / "other.jsonl"
    rows.append(one, [row(0)])
    rows.append(other, [row(0, nrmse=0.6)])
    one.write_bytes(one.read_bytes() + other.read_bytes())
    with pytest.raises(ValueError, match="lines 1 and 2, give different scores"):
        read_rows(one)


def test_blank_lines_and_uses_are_no_episodes(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0)])
    names = ("env_id", "setup", "condition", "game_hash", "estimator", "estimator_hash", "date")
    known = {"schema": 5, "kind": "use", **dict.fromkeys(names, "x"), "date": "2030-01-02"}
    path.write_text("\n" + path.read_text() + " \n" + json.dumps(known) + "\n\n")
    assert [r["episode"] for r in read_rows(path)] == ["seed:0"]


def test_a_cut_line_is_left_out_with_a_warning(tmp_path, caplog):
    path = tmp_path / "rows.jsonl"
    rows.append(path, [row(0), row(1)])
    path.write_bytes(path.read_bytes()[:-9])
    assert [r["episode"] for r in read_rows(path)] == ["seed:0"]
    assert "is cut off" in caplog.text


def test_a_table_has_each_episode_once_and_infinities(tmp_path):
    pytest.importorskip("pandas")
    options = {"window": 5}
    some = [row(0, nrmse=math.inf, options=options), row(1, anees=2.0), row(0, nrmse=math.inf)]
    table = Rows(some).to_pandas()
    assert list(table["episode"]) == ["seed:0", "seed:1"]
    assert list(table["nrmse"]) == [math.inf, 0.5]
    assert table["options"][0] == options
    assert table["anees"].dtype == float
    assert math.isnan(table["anees"][0])
    assert table["anees"][1] == 2.0


def test_the_table_of_an_evaluation_is_that_of_its_file(tmp_path):
    pandas = pytest.importorskip("pandas")
    path = tmp_path / "rows.jsonl"
    scored = evaluate("open_loop", "pinnobs/Academic-v0", episodes=2, results=path)
    own, stored = scored.to_pandas(), read_rows(path).to_pandas()
    pandas.testing.assert_frame_equal(own[sorted(own)], stored[sorted(own)])


def test_without_pandas_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^to_pandas needs pandas: pip install pandas$"):
        Rows([row(0)]).to_pandas()
