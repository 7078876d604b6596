"""The page about the architecture names every module, and nothing that is not there."""

from __future__ import annotations

import importlib
import re
import tomllib
from operator import attrgetter
from xml.etree import ElementTree

import pytest
from snippets import ROOT

PACKAGE = ROOT / "pinnobs_gym"
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
NAMED = set(re.findall(r"`((?:[\w]+/)*(?:\w+\.py|\w+/))`", PAGE))
"""Files and folders in the text, relative to the package or the root: `a/b.py`, `a/b/`."""
ANSWERS = re.findall(r"^\| [^|]*\? \| `([\w/]+)\.py` \| `([\w.]+)` \|$", PAGE, re.M)
"""File and name of each answer in the first table that is a definition."""


ZOO = ("systems", "estimators")
"""Rooms whose files are found by name: one is added without touching the page."""


def modules():
    """Every room and every module of machinery, as the page names them."""
    yield "trainers/"
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE)
        if path.name == "__init__.py":
            if path.parent != PACKAGE:
                yield f"{name.parent.as_posix()}/"
        elif path.name != "__main__.py" and name.parts[0] not in ZOO:
            yield name.as_posix()


def test_every_room_and_module_is_named():
    missing = {name for name in modules() if name not in NAMED}
    assert len(NAMED) > 60
    assert not missing, f"docs/architecture.md does not name {sorted(missing)}"


def test_each_has_a_line_of_its_own_in_the_code_map():
    lines = re.findall(r"^(?:- |### )`([\w/.]+)`: ", PAGE, re.M)
    assert len(lines) == len(set(lines))
    assert set(modules()) <= set(lines)


def test_what_it_names_is_there():
    gone = {n for n in NAMED if not (PACKAGE / n).exists() and not (ROOT / n).exists()}
    assert not gone, f"docs/architecture.md names {sorted(gone)}"


@pytest.mark.parametrize(("file", "name"), ANSWERS)
def test_an_answer_is_where_it_says(file, name):
    module = importlib.import_module(f"pinnobs_gym.{file.replace('/', '.')}")
    found = attrgetter(name)(module)
    owner, _, attribute = name.rpartition(".")
    assert attribute in vars(attrgetter(owner)(module) if owner else module)
    assert getattr(found, "__module__", module.__name__) == module.__name__


def test_there_are_answers():
    assert len(ANSWERS) > 10


def test_the_picture_shows_the_layers_of_the_import_contract():
    drawn = {}
    for text in ElementTree.parse(ROOT / "docs" / "architecture.svg").iter():
        if text.get("class") == "name":
            drawn[text.text] = float(text.get("y", "nan"))
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    rooms, trainers, *_ = settings["tool"]["importlinter"]["contracts"]
    heights = []
    for layer in rooms["layers"]:
        (height,) = {drawn.pop(name) for name in layer.split(" | ")}
        heights.append(height)
    assert heights == sorted(set(heights))
    order = [layer.rpartition(".")[2] for layer in trainers["layers"]]
    between = heights[1], drawn.pop("trainers"), heights[2]
    assert order == ["leaderboard", "trainers", "scoring"]
    assert between == tuple(sorted(between))
    assert not drawn
