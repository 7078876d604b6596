"""Names from rows and plug-ins are data: never paths, markup or code."""

import json
import re

import pytest
from made_rows import rows_of

from pinnobs_gym.cli import main
from pinnobs_gym.files import file_name
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import markdown
from pinnobs_gym.leaderboard.escapes import markdown_text
from pinnobs_gym.leaderboard.site.model import page_model
from pinnobs_gym.leaderboard.site.page import draw
from pinnobs_gym.scoring.rows import SCHEMA, Stored

NAMES = [
    "../../b",
    "/tmp/b",
    "..",
    "a/b",
    "a\\b",
    "c[/d]",
    "[bold]x",
    ":smile:",
    "a|b",
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    "`a`",
    "[a](http://b)",
    "a: b",
    "NUL",
    "x" * 300,
    "ä ö",
]
OBSERVERS = """
from dataclasses import dataclass

from pinnobs_gym.estimators.open_loop import OpenLoop


@dataclass(frozen=True)
class Up(OpenLoop):
    name = "../../b"


@dataclass(frozen=True)
class Closing(OpenLoop):
    name = "c[/d]"


@dataclass(frozen=True)
class Bold(OpenLoop):
    name = "<b>a|b</b>"
"""


@pytest.mark.parametrize("name", NAMES)
def test_a_file_name_is_one_part_of_a_path(name, tmp_path):
    made = file_name(name)
    path = tmp_path / made
    assert path.parent == tmp_path
    assert re.fullmatch(r"[\w+-][\w.+-]*", made, re.ASCII)
    assert len(made) < 100
    path.write_text("")
    assert list(tmp_path.iterdir()) == [path]


def test_file_names_are_kept_where_they_can_be_and_differ_where_names_do():
    for name in ("ekf", "kkl_pinn", "ReverseDuffing-v0", "noise5+dropout10", "noise0.1"):
        assert file_name(name) == name
    names = [*NAMES, "__a", "a_b", "a__b", "x" * 301, ""]
    assert len({file_name(name) for name in names}) == len(names)


def test_estimators_of_any_name_are_scored_within_the_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "named.py").write_text(OBSERVERS)
    names = {"../../b", "c[/d]", "<b>a|b</b>"}
    out = tmp_path / "deep" / "out"
    what = ["--systems", "ReverseDuffing", "--episodes", "1", "--jobs", "1", "--out", str(out)]
    own = ["--estimators", "named:Up", "named:Closing", "named:Bold"]
    assert main(["leaderboard", *what, *own]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in names)
    assert {path.name for path in tmp_path.iterdir()} <= {"deep", "named.py", "__pycache__"}
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"out"}
    rows = [json.loads(line) for line in (out / "rows.jsonl").read_text().splitlines()]
    assert {row["estimator"] for row in rows} == names
    page = tmp_path / "site"
    assert main(["report", str(out / "rows.jsonl"), "-o", str(page)]) == 0


def test_names_are_text_in_markdown_and_on_the_page():
    facts = {"schema": SCHEMA, "versions": {"numpy": "2"}, "batch": 1}
    stored = Stored([row for name in NAMES for row in rows_of(name, [0.1, 0.2], **facts)], [])
    lines = markdown(board(stored)).splitlines()
    for name in NAMES:
        shown = [line for line in lines if line.startswith("| ") and markdown_text(name) in line]
        assert shown, name
        for line in shown:
            cells = re.split(r"(?<!\\)\|", line)
            assert any(x.startswith("| ") and x.count("|") == len(cells) - 1 for x in lines), line
    html = draw(page_model(stored, []))
    assert "<script>alert" not in html
    assert "<img src=x" not in html
