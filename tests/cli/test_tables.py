"""The command `tables`, and the width of tables in a terminal, a pipe and a file."""

import csv
import io

import pytest
from made_rows import rows_of
from rich.console import Console

from pinnobs_gym.cli import console, main
from pinnobs_gym.leaderboard import chapters, ranks_table, standings_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.grid import Column, Grid
from pinnobs_gym.scoring import rows
from pinnobs_gym.scoring.rows import SCHEMA

MOTOR = {"env_id": "pinnobs/Motor-v0"}
LOADED = {**MOTOR, "condition": "load_step", "ranked": False}
MIXED = {**MOTOR, "condition": "dropout10+noise5", "ranked": False}


FACTS = {"schema": SCHEMA, "kind": "score", "versions": {}, "knows": ["model", "noise"]}


@pytest.fixture
def path(tmp_path):
    """A file of two estimators, one of an evil name, on two systems and three conditions."""
    scored = []
    for game in ({}, MOTOR, LOADED, MIXED):
        scored += rows_of("ekf", [0.2] * 60, **game, **FACTS)
        scored += rows_of("=a_b|\x1b[1m", [0.1] * 60, **game, **FACTS)
    rows.append(tmp_path / "rows.jsonl", scored)
    return tmp_path / "rows.jsonl"


@pytest.fixture
def printed(path, capsys):
    """Run the command with arguments and return what it prints."""

    def run(*arguments):
        assert main(["tables", str(path), *map(str, arguments)]) == 0
        return capsys.readouterr().out

    return run


def titles(text):
    names = ("Across", "Ranks", "pinnobs/")
    return [line for line in text.splitlines() if line.startswith(names)]


ALL = [
    "Across systems",
    "Ranks",
    "pinnobs/Motor-v0, benchmark, dropout10+noise5",
    "pinnobs/Motor-v0, benchmark, load_step",
    "pinnobs/Motor-v0, benchmark, nominal",
    "pinnobs/X-v0, benchmark, nominal",
]


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ([], ALL),
        (["overview"], ALL[:1]),
        (["ranks", "X"], [ALL[1], ALL[5]]),
        (["Motor"], ALL[2:5]),
        (["Motor-v0,load_step"], ALL[3:4]),
        (["pinnobs/Motor-v0, noise5+dropout10"], ALL[2:3]),
    ],
)
def test_tables_are_chosen_by_name(printed, names, expected):
    assert titles(printed(*(["--table", *names] if names else []))) == expected


def test_markdown_latex_and_csv(printed):
    markdown = printed("--table", "X", "--format", "markdown")
    assert markdown.startswith(
        "## pinnobs/X-v0, benchmark, nominal\n\n| rank | estimator | steady |"
    )
    assert "| 1 | =a_b\\|�" in markdown
    latex = printed("--table", "X", "--format", "latex", "--columns", "estimator", "steady")
    assert r"\begin{tabular}{lr}" in latex
    assert r"=a\_b\textbar{}? & 0.1 \\" in latex
    header, first, second = csv.reader(io.StringIO(printed("--table", "X", "--format", "csv")))
    assert header[:2] == ["rank", "estimator"]
    assert first[:2] == ["1", "'=a_b|\x1b[1m"]
    assert second[:2] == ["2", "ekf"]
    assert len(header) == len(first) == len(second)


def test_a_file_has_all_columns_at_any_width(printed, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    told = printed("--table", "X", "-o", tmp_path / "new" / "x.txt")
    written, following = told.splitlines()
    assert written == f"tables: {tmp_path / 'new' / 'x.txt'}"
    assert following.startswith("next: pinnobs report ")
    text = (tmp_path / "new" / "x.txt").read_text(encoding="utf-8")
    assert "  knows " in text
    assert "not shown" not in text
    narrow = printed("--table", "X")
    assert "µs/step, training (-o FILE writes all)" in " ".join(narrow.split())
    assert "\nrank  estimator  steady  transient  diverged %  track   knows\n" in narrow
    assert max(map(len, narrow.splitlines())) <= 80
    monkeypatch.delenv("COLUMNS")
    assert printed("--table", "X") == text


def test_no_name_steers_the_terminal(printed, path):
    assert "\x1b" not in printed()
    assert "=a_b|�" in printed()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--table", "Y"], "unknown table 'Y'; known are overview, ranks, Motor-v0, X-v0"),
        (["--table", "X,noise5"], "no table 'X,noise5'; known are 'X,benchmark,nominal'\n"),
        (["--table", "X,paper"], "no table 'X,paper'; known are 'X,benchmark,nominal'\n"),
        (["--table", "on-record X"], "unknown table 'on-record X'; known are overview, ranks, "),
        (["--format", "csv"], "csv holds one table, not 6 (Across systems; Ranks; pinnobs/Mot"),
        (["--format", "html"], "invalid choice 'html' for argument '--format'"),
        (["--table", "X", "--columns", "RMSE"], "unknown column 'RMSE' of 'pinnobs/X-v0, benchma"),
        (["-o", "rows.jsonl/x"], "cannot write rows.jsonl/x"),
        (["none.jsonl"], "there is no rows file none.jsonl"),
    ],
)
def test_mistakes_are_one_line_and_status_two(path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(path.parent)
    assert main(["tables", "rows.jsonl", *arguments]) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.startswith("pinnobs: error: ")
    assert (len(printed.err.splitlines()), printed.out) == (1, "")


def test_no_rows_are_mistakes_too(tmp_path, capsys):
    (tmp_path / "rows.jsonl").touch()
    assert main(["tables"]) == 2
    assert "no rows file is given" in capsys.readouterr().err
    assert main(["tables", str(tmp_path / "rows.jsonl")]) == 2
    assert "no scored episodes in" in capsys.readouterr().err


def test_estimators_trained_on_each_record_have_tables_of_their_own(path, printed):
    assert "trained on each record" not in printed()
    own = {"training": {"per_record": True}, "track": "offline", "estimator_hash": "pinn"}
    rows.append(path, rows_of("pinn", [0.1, 0.1], **FACTS, **own))
    apart = [f"{ALL[0]}, trained on each record", f"{ALL[5]}, trained on each record"]
    assert titles(printed()) == [*ALL, *apart]
    assert titles(printed("--table", "X")) == [ALL[5]]
    assert titles(printed("--table", "on-record X")) == apart[1:]
    chosen = printed("--table", "on-record overview")
    assert titles(chosen) == apart[:1]
    assert "pinn" in chosen
    assert "pinn" not in printed("--table", "overview")


def test_setup_condition_and_part_choose_one_table(path, printed, capsys):
    facts = {**FACTS, "condition": "mismatch10", "ranked": False}
    paper = {**FACTS, "setup": "paper", "game_hash": "paper"}
    own = {"training": {"per_record": True}, "track": "offline", "estimator_hash": "pinn"}
    for name, more in (("ekf", {}), ("pinn", own)):
        rows.append(path, rows_of(name, [0.1, 0.1], **facts, **more))
        rows.append(path, rows_of(name, [0.1], **paper, **more))
    apart = ", trained on each record"
    on_paper, mismatched = "pinnobs/X-v0, paper, nominal", "pinnobs/X-v0, benchmark, mismatch10"
    assert titles(printed("--table", "X")) == [mismatched, ALL[5], on_paper]
    for name, title in (
        ("X,paper", on_paper),
        ("X, nominal, paper", on_paper),
        ("X-v0,paper,nominal", on_paper),
        ("on-record X,paper", on_paper + apart),
        ("on-record pinnobs/X-v0,mismatch10", mismatched + apart),
        ("on-record X,mismatch10,benchmark", mismatched + apart),
    ):
        assert titles(printed("--table", name)) == [title]
        lines = list(csv.reader(io.StringIO(printed("--table", name, "--format", "csv"))))
        assert ("pinn" in [line[1] for line in lines]) == title.endswith(apart)
    assert main(["tables", str(path), "--table", "on-record X,gap"]) == 2
    known = "known are 'on-record X,benchmark,mismatch10', 'on-record X,paper,nominal'"
    assert known in capsys.readouterr().err
    assert main(["tables", str(path), "--table", "Y"]) == 2
    known = "known are overview, ranks, Motor-v0, X-v0, on-record X-v0\n"
    assert capsys.readouterr().err.endswith(known)


def test_all_tables_have_their_explanations(path, printed, tmp_path):
    failure = {"schema": SCHEMA, "kind": "failure", "env_id": "pinnobs/X-v0", "setup": "benchmark"}
    failure |= {"condition": "nominal", "estimator": "`mine`", "episode": "seed:0", "episodes": 1}
    rows.append(path, [failure | {"job": "x", "error": "no *luck*", "date": "2030-01-01"}])
    notes = ranks_table.NOTE, ranks_table.RANK_NOTE, standings_table.NOTE
    text = " ".join(printed().split())
    assert [text.count(note) for note in notes] == [1, 1, 1]
    assert text.index(notes[0]) < text.index("Ranks") < text.index(notes[1]) < text.index(notes[2])
    markdown = printed("--format", "markdown")
    assert all(f"\n\n{note}\n\n" in markdown for note in notes)  # with their own markup
    assert "Failed: \\`mine\\`, seed:0: no \\*luck\\*." in markdown  # names are no markup
    assert chapters.markdown(board(rows.load(path))) == markdown
    for form in ("text", "markdown"):
        assert not any(note in printed("--table", "X", "--format", form) for note in notes)


def test_explanations_are_as_wide_as_the_tables(printed, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert 70 < max(map(len, printed().splitlines())) <= 80


def test_what_is_left_out_is_told_beside_the_tables(path, capsys):
    rows.append(path, rows_of("ekf", [0.15], game_hash="older", date="2029-01-01", **FACTS))
    assert main(["tables", str(path), "--table", "X"]) == 0
    printed = capsys.readouterr()
    assert "1 episodes of pinnobs/X-v0, benchmark, nominal are left out" in printed.err
    assert "left out" not in printed.out


@pytest.mark.parametrize(
    ("columns", "width"),
    [(None, None), ("80", 80), ("0", None), ("wide", None), ("", None)],
)
def test_a_pipe_has_no_width_unless_it_is_given(monkeypatch, columns, width):
    monkeypatch.setattr(console, "console", Console(file=io.StringIO(), width=100))
    if columns is None:
        monkeypatch.delenv("COLUMNS", raising=False)
    else:
        monkeypatch.setenv("COLUMNS", columns)
    assert console.table_width() == width


def test_a_terminal_has_its_own_width_and_no_line_is_wrapped(monkeypatch):
    written = io.StringIO()
    terminal = Console(file=written, force_terminal=True, width=30, color_system=None)
    monkeypatch.setattr(console, "console", terminal)
    assert console.table_width() == 30
    name = "[bold]a name of forty characters, :smile:"
    columns = (Column("name", numeric=False), Column("n"))
    console.print_table([[Grid("", columns, ((name, "1"),))]])
    assert written.getvalue() == f"name: {name}\nn:    1\n\n"
    written.truncate(written.seek(0))
    columns = (Column("name", numeric=False), Column("number"), Column("x" * 30, 1))
    console.print_table([[Grid("", columns, (("a", "1", "2"),))]], "x")
    told = f"not shown at this width:\n{'x' * 30}\n(x)\n\n"
    assert written.getvalue() == f"name  number\n----  ------\na          1\n{told}"
