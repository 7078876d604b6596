"""Tables of measured figures."""

import json

import measured
import pytest


@pytest.fixture
def groups(tmp_path):
    def line(figure, value, asked="", holds=None, date="2026-01-02", group="core"):
        fields = ("group", "figure", "value", "unit", "asked", "holds", "date")
        return dict(zip(fields, (group, figure, value, "x", asked, holds, date), strict=True))

    lines = [
        line("slow", 1.5, ">= 1", True, date="2026-01-01"),
        line("missed", 2, ">= 3", False),
        line("free", 4),
    ]
    path = tmp_path / "core.jsonl"
    path.write_text("".join(json.dumps(each) + "\n" for each in lines))
    return measured.read(tmp_path)


def test_a_file_has_the_figures_of_its_group(groups):
    assert [(f["figure"], f["value"]) for f in groups["core"]] == [
        ("slow", 1.5),
        ("missed", 2),
        ("free", 4),
    ]


def test_the_readme_says_what_holds_and_what_is_missed(groups):
    section = measured.readme_section(groups)
    assert "| `core` | 1 of 2 | missed: 2 x, asked >= 3 |" in section
    assert "Measured on 2026-01-01 to 2026-01-02 by" in section


def test_of_many_missed_bounds_the_first_three_are_named(groups):
    (figure,) = (each for each in groups["core"] if each["holds"] is False)
    groups["core"] = [{**figure, "figure": f"missed {i}"} for i in range(5)]
    section = measured.readme_section(groups)
    assert "missed 2: 2 x, asked >= 3; and 2 more |" in section
    assert "missed 3" not in section


def test_the_page_has_every_figure(groups):
    page = measured.page(groups)
    assert "| missed | 2 x | >= 3 **missed** |" in page
    assert "| free | 4 x |  |" in page


def test_no_folder_is_no_figures(tmp_path):
    assert measured.read(tmp_path / "none") == {}
