"""One table as text of several widths, Markdown, LaTeX and CSV."""

import csv
import io
import random
import re
import shutil
import subprocess

import pytest
from rich.cells import cell_len

from pinnobs_gym.leaderboard.display import filled, padded, printable, width_of
from pinnobs_gym.leaderboard.escapes import PACKAGES, csv_text, latex_text, markdown_text, quoted
from pinnobs_gym.leaderboard.grid import GAP, WANTED, Column, Grid, fitting, markdown_table

COLUMNS = (
    Column("rank"),
    Column("estimator", numeric=False),
    Column("episodes", 1),
    Column("diverged %"),
    Column("NRMSE"),
    Column("tail NRMSE"),
    Column("ANEES", 2),
    Column("µs/step", 3),
    Column("knows", 4, numeric=False),
    Column("training", 5, numeric=False),
)
KNOWS = "model, prior, noise, initial set, true states in training"
LINES = (
    *(("1", "kkl_pinn, 45 s", "100", "0", "0.0391 (0.037-0.04)", "0.00278 (0.0026-0.003)"),),
    *(("2", "ekf", "100", "12", "0.0412 (0.039-0.043)", "0.00281 (0.0027-0.0029)"),),
    *(("3", "推定器", "100", "100", "∞", "∞"),),
    *(("1", "rts_smoother", "100", "0", "0.0118 (0.011-0.012)", "0.00122 (0.0011-0.0013)"),),
)
MORE = (
    ("", "0.58", KNOWS, "budget 45 s, 659 iterations, 45.02 CPU s"),
    ("1.52 ▲", "9.6", "model, prior, noise", ""),
    ("0.7 ▼", "121", "model", ""),
    ("0.98", "24", "model, prior, noise", ""),
)
GRID = Grid(
    "pinnobs/Academic-v0, benchmark, nominal",
    COLUMNS,
    tuple((*first, *last) for first, last in zip(LINES, MORE, strict=True)),
    blocks=(3,),
    note="Failed: mhe, episode 3: RuntimeError: out of luck.",
)
AT_80 = """\
pinnobs/Academic-v0, benchmark, nominal
rank  estimator       diverged %                 NRMSE               tail NRMSE
----  --------------  ----------  --------------------  -----------------------
   1  kkl_pinn, 45 s           0   0.0391 (0.037-0.04)   0.00278 (0.0026-0.003)
   2  ekf                     12  0.0412 (0.039-0.043)  0.00281 (0.0027-0.0029)
   3  推定器                 100                     ∞                        ∞
----  --------------  ----------  --------------------  -----------------------
   1  rts_smoother             0  0.0118 (0.011-0.012)  0.00122 (0.0011-0.0013)
Failed: mhe, episode 3: RuntimeError: out of luck.
not shown at this width: episodes, ANEES, µs/step, knows, training
(leaderboard.md has all)"""
AT_120 = """\
pinnobs/Academic-v0, benchmark, nominal
rank  estimator       episodes  diverged %                 NRMSE               tail NRMSE   ANEES  µs/step
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------
   1  kkl_pinn, 45 s       100           0   0.0391 (0.037-0.04)   0.00278 (0.0026-0.003)             0.58
   2  ekf                  100          12  0.0412 (0.039-0.043)  0.00281 (0.0027-0.0029)  1.52 ▲      9.6
   3  推定器               100         100                     ∞                        ∞   0.7 ▼      121
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------
   1  rts_smoother         100           0  0.0118 (0.011-0.012)  0.00122 (0.0011-0.0013)    0.98       24
Failed: mhe, episode 3: RuntimeError: out of luck.
not shown at this width: knows, training (leaderboard.md has all)"""  # noqa: E501
AT_200 = """\
pinnobs/Academic-v0, benchmark, nominal
rank  estimator       episodes  diverged %                 NRMSE               tail NRMSE   ANEES  µs/step  knows
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------  ---------------------------------------------------------
   1  kkl_pinn, 45 s       100           0   0.0391 (0.037-0.04)   0.00278 (0.0026-0.003)             0.58  model, prior, noise, initial set, true states in training
   2  ekf                  100          12  0.0412 (0.039-0.043)  0.00281 (0.0027-0.0029)  1.52 ▲      9.6  model, prior, noise
   3  推定器               100         100                     ∞                        ∞   0.7 ▼      121  model
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------  ---------------------------------------------------------
   1  rts_smoother         100           0  0.0118 (0.011-0.012)  0.00122 (0.0011-0.0013)    0.98       24  model, prior, noise
Failed: mhe, episode 3: RuntimeError: out of luck.
not shown at this width: training (leaderboard.md has all)"""  # noqa: E501
WHOLE = """\
pinnobs/Academic-v0, benchmark, nominal
rank  estimator       episodes  diverged %                 NRMSE               tail NRMSE   ANEES  µs/step  knows                                                      training
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------  ---------------------------------------------------------  ----------------------------------------
   1  kkl_pinn, 45 s       100           0   0.0391 (0.037-0.04)   0.00278 (0.0026-0.003)             0.58  model, prior, noise, initial set, true states in training  budget 45 s, 659 iterations, 45.02 CPU s
   2  ekf                  100          12  0.0412 (0.039-0.043)  0.00281 (0.0027-0.0029)  1.52 ▲      9.6  model, prior, noise
   3  推定器               100         100                     ∞                        ∞   0.7 ▼      121  model
----  --------------  --------  ----------  --------------------  -----------------------  ------  -------  ---------------------------------------------------------  ----------------------------------------
   1  rts_smoother         100           0  0.0118 (0.011-0.012)  0.00122 (0.0011-0.0013)    0.98       24  model, prior, noise
Failed: mhe, episode 3: RuntimeError: out of luck."""  # noqa: E501


@pytest.mark.parametrize(
    ("width", "expected"), [(80, AT_80), (120, AT_120), (200, AT_200), (None, WHOLE)]
)
def test_text_of_a_leaderboard(width, expected):
    assert GRID.text(width, "leaderboard.md has all") == expected


def test_a_table_that_cannot_fit_becomes_records():
    columns = (Column("name", numeric=False), Column("what it is", numeric=False), Column("n", 1))
    lines = (("ekf", "a filter " * 5, "2"), ("µkf", "an observer of any length", ""), ("c", "", ""))
    assert Grid("", columns, lines, blocks=(2,)).text(30) == (
        "name:       ekf\n"
        f"what it is: {'a filter ' * 5}\n"
        "n:          2\n"
        "\n"
        "name:       µkf\n"
        "what it is: an observer of any length\n"
        "\n"
        "-----------\n"
        "\n"
        "name:       c"
    )


def test_columns_are_dropped_by_priority_and_of_equals_the_rightmost():
    names, priorities = "abcdefg", (0, 2, 1, 3, 2, 0, 1)
    columns = tuple(map(Column, names, priorities))
    grid = Grid("", columns, (tuple("1234567"),))
    shown = [grid.text(width).splitlines()[0].split() for width in range(19, 3, -3)]
    assert ["".join(names) for names in shown] == [
        "abcdefg",
        "abcefg",
        "abcfg",
        "acfg",
        "acf",
        "af",
    ]
    assert grid.fits(4)
    assert not grid.fits(3)
    assert grid.text(19).count("\n") == 2
    assert grid.text(18).endswith("\nnot shown at this\nwidth: d")


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("", 0),
        ("µ∞▲▼x̂₀−", 7),  # the hat is a combining mark
        ("推定器", 6),
        ("ＡＢ", 4),
        ("e\u0301", 1),
        ("가", 2),
        ("\u1100\u1161\u11a8", 2),  # the same kind of syllable in three parts
        ("🙂", 2),
        ("�", 1),
    ],
)
def test_display_widths(text, columns):
    assert width_of(text) == columns
    assert cell_len(text) == columns
    for right in (False, True):
        assert width_of(padded(text, columns + 3, right)) == columns + 3


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("a\x1b[31mred\x1b[0m", "a�red�"),
        ("\x1b]0;title\x07b", "�b"),
        ("\x1b", "�"),
        ("a\nb\tc\rd\x08\x00\x9b", "a�b�c�d���"),
        ("\u202egnp.exe\u2069\u200b\ufeff", "�gnp.exe���"),
        ("\u2028\ud800", "��"),
        ("x̂ µ ∞ 推 🙂", "x̂ µ ∞ 推 🙂"),
    ],
)
def test_characters_that_would_steer_a_terminal_are_shown(text, shown):
    assert printable(text) == shown
    grid = Grid(text, (Column(text), Column("n")), ((text, "1"),), note=text)
    for width in (None, 4):
        assert not re.search("[\\x00-\\x09\\x0b-\\x1f\\x7f-\\x9f\\u200b-\\u202e]", grid.text(width))


PIECES = ["0.0391", "∞", "推定", "é", "e\u0301", "1.5 ▲", "a b", "-3", "", "\x1b[1m", "x" * 12, "|"]


def random_grid(rng):
    names = [f"{rng.choice('abc推µ')}{i}{'n' * rng.randrange(6)}" for i in range(rng.randint(1, 9))]
    columns = tuple(Column(n, rng.randrange(4), rng.random() < 0.5) for n in names)
    lines = tuple(
        tuple("".join(rng.choices(PIECES, k=rng.randrange(3))) for _ in names)
        for _ in range(rng.randrange(5))
    )
    return Grid("two words", columns, lines, blocks=(1,), note="a note of a few short words")


@pytest.mark.parametrize("seed", range(100))
def test_no_cell_is_ever_cut_and_no_line_is_too_wide(seed):
    rng = random.Random(seed)
    grid = random_grid(rng)
    for width in (*rng.sample(range(12, 100), 10), None):
        text = grid.text(width)
        told = text.replace("\n", " ").partition("not shown at this width: ")[2].split(", ")
        dropped = [name in told for name in grid.header]
        assert not any(
            gone and not c.priority for gone, c in zip(dropped, grid.columns, strict=True)
        )
        own = text.splitlines()
        for line in grid.lines:
            cells = [
                printable(c).strip() for c, gone in zip(line, dropped, strict=True) if not gone
            ]
            if grid.fits(width):  # all of them in one line, in their order
                pattern = " *".join(map(re.escape, filter(None, cells)))
                assert any(re.fullmatch(f" *{pattern} *", each) for each in own)
            else:
                assert not any(dropped)
                assert all(any(each.endswith(cell) for each in own) for cell in cells)
        if width is not None and grid.fits(width):
            assert max(map(cell_len, own)) <= width
        if width is None:
            assert not any(dropped)


def test_dropping_one_column_less_would_not_have_fitted():
    rng = random.Random(0)
    tried = 0
    for _ in range(200):
        grid = random_grid(rng)
        width = rng.randrange(10, 80)
        shown = [n for n in grid.header if n in grid.text(width).splitlines()[1].split()]
        gone = [c for c in grid.columns if c.name not in shown]
        if not grid.fits(width) or not gone:
            continue
        tried += 1
        back = min(gone, key=lambda c: c.priority).name  # the last that was dropped
        with_it = grid.only([n for n in grid.header if n in shown or n == back])
        widths = [
            max(cell_len(printable(cell)) for cell in cells)
            for cells in zip(with_it.header, *with_it.lines, strict=True)
        ]
        assert sum(widths) + len(GAP) * (len(widths) - 1) > width
    assert tried > 50


def test_words_fill_lines_and_are_not_cut():
    assert filled(["a", "bb", "ccc", "dddd", "推定", "e"], 5) == "a bb\nccc\ndddd\n推定\ne"
    assert filled(["longer", "than"], 3) == "longer\nthan"
    assert filled([], 3) == ""


def test_the_first_layout_that_fits_is_taken_and_otherwise_the_last():
    wide, narrow = (Grid("", (Column("n" * size),), ()) for size in (20, 10))
    layouts = [[wide], [narrow, narrow]]
    assert fitting(layouts, None) == [wide]
    assert fitting(layouts, 20) == [wide]
    assert fitting(layouts, 19) == [narrow, narrow]
    assert fitting(layouts, 5) == [narrow, narrow]


def test_a_layout_with_room_for_wanted_columns_is_taken_before_one_that_drops_them():
    def made(size, wanted):
        columns = (Column("n" * size), Column("w" * 6, wanted), Column("d" * 6, WANTED + 1))
        return Grid("", columns, ())

    for wanted in range(1, WANTED + 1):
        long, short = made(20, wanted), made(10, wanted)
        assert fitting([[long], [short]], 28) == [long]  # 20 + 2 + 6
        assert fitting([[long], [short]], 27) == [short]
        assert fitting([[long], [short]], 18) == [short]
        assert fitting([[short], [made(5, wanted)], [long]], 17) == [made(5, wanted)]
        assert fitting([[long], [long, short]], 22) == [long]  # room for the wanted in neither
    some = made(20, 2), made(10, 3)
    assert fitting([[each] for each in some], 27) == [some[1]]
    first, second = (
        Grid("", (Column("n" * n), Column("w", 1), Column("v", 3)), ()) for n in (9, 8)
    )
    assert fitting([[first], [second]], 11) == [second]  # 8 + 2 + 1
    assert fitting([[made(20, WANTED + 1)], [short]], 20) == [made(20, WANTED + 1)]


NASTY = ["a|b", "<script>alert(1)</script>", "[x](y)", "`code`", "two\nlines", "*a*", "a\\b", ""]


def test_markdown_of_any_cell_has_one_line_and_as_many_cells():
    columns = (Column("n|m"), Column("`x`"))
    grid = Grid("<b>", columns, tuple((cell, cell) for cell in NASTY), note="a\n|b")
    heading, table, note = grid.markdown().split("\n\n")
    assert (heading, note) == ("## \\<b\\>", "a \\|b")
    header, rule, *lines = table.splitlines()
    assert (header, rule) == ("| n\\|m | \\`x\\` |", "| --- | --- |")
    assert len(lines) == len(NASTY)
    for line, cell in zip(lines, NASTY, strict=True):
        own = re.split(r"(?<!\\)\|", line.replace("\\\\", ""))
        assert len(own) == 4
        assert markdown_text(cell).replace("\\\\", "") == own[1].strip() == own[2].strip()
        assert not re.search(r"(?<!\\)[<>`*]|(?<!\\)\]\(", own[1])
    assert markdown_table(["a"], [["**b**"]]) == "| a |\n| --- |\n| **b** |"


LATEX = {
    "50 %": r"50 \%",
    "kkl_pinn & co": r"kkl\_pinn \& co",
    "$x^2$ #1 {a}": r"\$x\textasciicircum{}2\$ \#1 \{a\}",
    "a\\b~c": r"a\textbackslash{}b\textasciitilde{}c",
    "<a|b>": r"\textless{}a\textbar{}b\textgreater{}",
    "∞ µ ▲ ▼ −1 ±": r"$\infty$ \textmu{} $\blacktriangle$ $\blacktriangledown$ $-$1 $\pm$",
    "0.1-0.2": "0.1-0.2",
    "a--b---": "a-{}-b-{}-{}-",
    "[1pt]*": "{[}1pt{]}{*}",
    "`a'": r"\textasciigrave{}a\textquotesingle{}",
    "two\nlines\x1b": "two lines?",
    "Kalmán": "Kalmán",
}


@pytest.mark.parametrize(("text", "expected"), LATEX.items())
def test_latex_escapes(text, expected):
    assert latex_text(text) == expected


def test_words_are_quoted_for_a_shell():
    """bash reads back what was quoted, and nothing in it is run or cannot be seen."""
    words = ["ekf", "a b", "it's", "$(touch x)", "`id`", "a;b", "~", "", "$'x'", "\\\\", "ä*"]
    words += ["\x1b[31m'\\", "a\nb", "\u202ex", "\x85", "a\x7fb1"]
    line = " ".join(map(quoted, words))
    assert line.isprintable()
    if bash := shutil.which("bash"):
        command = [bash, "-c", f"printf '%s\\0' {line}"]
        read = subprocess.run(command, check=True, capture_output=True).stdout
        assert read.decode().split("\0")[:-1] == words
    assert quoted("a\udcffb") == r"$'a\xffb'"  # a byte of a file's name that is no text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("&lt;b&gt;", r"\&lt;b\&gt;"),
        ("_a_ b_c", r"\_a\_ b_c"),
        ("~~a~~ $x$", r"\~\~a\~\~ \$x\$"),
        ("http://b www.b a@b", r"http\://b www\.b a\@b"),
    ],
)
def test_markdown_escapes(text, expected):
    assert markdown_text(text) == expected


def test_latex_of_a_table():
    columns = (Column("name", numeric=False), Column("n %"))
    grid = Grid("A\ntitle", columns, (("a_b", "1"), ("[c", "∞")), blocks=(1,), note="50 %")
    assert grid.latex().splitlines() == [
        "% A title",
        "% 50 %",
        r"% \usepackage{booktabs,amssymb}",
        r"\begin{tabular}{lr}",
        r"\toprule",
        r"name & n \% \\",
        r"\midrule",
        r"a\_b & 1 \\",
        r"\midrule",
        r"{[}c & $\infty$ \\",
        r"\bottomrule",
        r"\end{tabular}",
    ]
    assert r"\begin{tabular}{r}" in grid.only(["n %"]).latex()


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path):
    lines = tuple((text, "1") for text in [*LATEX, *NASTY])
    grid = Grid("T", (Column("name", numeric=False), Column("n %")), lines, blocks=(2,))
    packages = rf"\usepackage{{{','.join(PACKAGES)}}}"
    document = rf"\documentclass{{article}}{packages}\begin{{document}}"
    text = "\n".join([document, grid.latex(), r"\end{document}"])
    (tmp_path / "t.tex").write_text(text, encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]


def test_csv_is_read_back_as_it_was():
    cells = [*NASTY, 'a "b", c', "-0.1", "+3", "-1e-3", "∞", "1.52 ▲", "a=b", " x ", "\x1b", "'"]
    cells += ["a\rb", "a\r\nb", "a\nb"]
    columns = (Column("name, of it"), Column("-n"))
    text = Grid("T", columns, tuple((cell, "1") for cell in cells), note="N").csv()
    header, *lines = csv.reader(io.StringIO(text, newline=""))
    assert header == ["name, of it", "'-n"]
    assert lines == [[cell, "1"] for cell in cells]
    assert text.endswith("\n")
    assert text.startswith('"name, of it",\'-n\n')  # lines end in a line feed alone


@pytest.mark.parametrize("cell", ["=1+1", "+a", "-a", "@SUM(A1)", "\t=1", "\r=1", "-1+2", "-"])
def test_csv_cells_that_a_spreadsheet_would_compute_are_text(cell):
    assert csv_text(cell) == "'" + cell


def test_columns_by_name():
    assert GRID.only(["NRMSE", "rank"]).lines[0] == ("0.0391 (0.037-0.04)", "1")
    assert GRID.only(["NRMSE"]).blocks == GRID.blocks
    with pytest.raises(
        ValueError, match=r"unknown column 'RMSE' of 'pinnobs/.*; known are rank, e"
    ):
        GRID.only(["RMSE"])
    with pytest.raises(ValueError, match=r"line 1 of 'T' has 2 cells, not 1"):
        Grid("T", (Column("a"),), (("1",), ("1", "2")))
