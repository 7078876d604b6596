"""The documentation's style sheet on that of its theme, in a browser, and the classes it uses."""

import sys
from importlib import resources

import pytest
from docutils.core import publish_doctree
from docutils.nodes import entry
from snippets import ROOT
from waiting import PATIENCE

NAME = "pinnobs_gym.leaderboard.site.over_samples.a_name_that_is_longer_than_half_of_a_window()"


@pytest.fixture(scope="module")
def made():
    """The modules of the documentation that the pages are made with."""
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import mathml
        import moving
        import short_cells
    finally:
        sys.path.remove(str(ROOT / "docs"))
    return mathml, short_cells, moving


@pytest.fixture
def shown(browser):
    """Shows a part of a page in a window of some width."""
    contexts = []

    def shown(body, width):
        theme = resources.files("furo") / "theme/furo/static/styles/furo.css"
        own = ROOT / "docs/_static/site.css"
        css = "".join(path.read_text(encoding="utf-8") for path in (theme, own))
        contexts.append(browser.new_context(viewport={"width": width, "height": 800}, offline=True))
        page = contexts[-1].new_page()
        page.set_content(
            f"<!doctype html><style>{css}</style><article role=main>{body}</article>",
            timeout=1000 * PATIENCE,
        )
        return page

    yield shown
    for context in contexts:
        context.close()


def test_numbers_of_a_matrix_stand_apart(made, shown):
    r"""-1 beside 0 is not -10, also in an equation that is aligned with others."""
    latex = r"\begin{aligned} F &= \begin{pmatrix} -1 & 0 \\ 1 & 2 \end{pmatrix} \end{aligned}"
    page = shown(made[0].mathml(latex, block=True), 1280)
    gaps = page.evaluate(
        """() => [...document.querySelectorAll("mtable mtable mtr")].map((row) => {
            const [left, right] = [...row.children].map((cell) => {
                const range = document.createRange();
                range.selectNodeContents(cell);
                return range.getBoundingClientRect();
            });
            return right.left - left.right;
        })"""
    )
    assert len(gaps) == 2
    assert min(gaps) > 5


@pytest.mark.parametrize("width", [390, 1280])
def test_a_heading_is_larger_than_those_below_it(shown, width):
    page = shown("<h1>A</h1><h2>B</h2><h3>C</h3>", width)
    sizes = page.eval_on_selector_all(
        "h1, h2, h3", "all => all.map(each => parseFloat(getComputedStyle(each).fontSize))"
    )
    assert sizes[0] > sizes[1] > sizes[2]


def test_a_number_is_in_one_line_on_a_phone(made, shown):
    text = """
=========== ======== ======================================================
steady      ukf      knows
=========== ======== ======================================================
1.1 (1-1.2) 1e-05    model, prior, noise, initial set, true states in training
=========== ======== ======================================================
"""
    document = publish_doctree(text, settings_overrides={"report_level": 5})
    made[1].mark(None, document)
    short = ["short" in cell["classes"] for cell in document.findall(entry)]
    assert short == [False, False, False, True, True, False]  # none of a head
    cells = "".join(f"<td class={'short' if i < 9 else 'long'}>1.1 (1-1.2)</td>" for i in range(10))
    page = shown(f"<table class=docutils><tbody><tr>{cells}</tr></tbody></table>", 390)
    page.eval_on_selector("td.long", f"cell => {{ cell.textContent = {text!r} }}")
    height, line = page.eval_on_selector(
        "td.short",
        """cell => {
            const range = document.createRange();
            range.selectNodeContents(cell);
            return [range.getClientRects().length, cell.getBoundingClientRect().width];
        }""",
    )
    assert height == 1
    assert line > 60


def test_long_names_of_the_index_end_within_the_page(shown):
    entries = f"<ul><li><a href=#>{NAME}</a></li></ul>"
    page = shown(
        f'<table class="indextable genindextable"><tr><td>{entries}<td>{entries}</tr></table>', 900
    )
    assert page.evaluate("document.documentElement.scrollWidth") <= 900


def test_the_legend_of_a_moving_picture_can_be_read(made):
    """Its texts have the colours of the lines, on white; the contrast is that of WCAG 2, AA."""
    for colour in (made[2].TRUE, made[2].ESTIMATE, made[2].MEASURED):
        parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        linear = [v / 12.92 if v <= 0.04045 else ((v + 0.055) / 1.055) ** 2.4 for v in parts]
        assert 1.05 / (0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2] + 0.05) > 4.5
