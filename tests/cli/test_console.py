"""What a terminal gets of names and messages that would steer it."""

import io
import logging
import warnings

import pytest
from rich.markdown import Markdown
from rich.progress import Progress, TextColumn
from rich.text import Text

from pinnobs_gym.cli import main
from pinnobs_gym.cli.console import PrintableConsole
from pinnobs_gym.leaderboard.display import show_messages_printable

HOSTILE = "a\x1b[2Jb\x1b]0;title\x07c\x9b31md\u202ee\rf\x08\u2028g"
SEEN = "a�b�c�31md�e�f��g"
"""What is seen of it; line feeds are kept."""


def shown(renderable, **options):
    file = io.StringIO()
    console = PrintableConsole(file=file, width=60, force_terminal=True, color_system=None)
    console.print(renderable, **options)
    return file.getvalue()


def is_plain(text):
    return all(character.isprintable() or character == "\n" for character in text)


@pytest.mark.parametrize("made", [str, Text, lambda text: Markdown(text, hyperlinks=False)])
def test_what_is_printed_steers_no_terminal(made):
    assert is_plain(shown(made(f"{HOSTILE}\n\n2"), soft_wrap=True))


def test_a_bar_is_moved_by_the_console_alone():
    """Its own escape sequences are written, those of a description are not."""
    file = io.StringIO()
    console = PrintableConsole(file=file, width=60, force_terminal=True, color_system=None)
    columns = TextColumn("{task.description}", markup=False)
    with Progress(columns, console=console, auto_refresh=False) as bar:
        bar.add_task(HOSTILE)
        bar.refresh()
    text = file.getvalue()
    assert "\x1b[?25l" in text  # the cursor is hidden
    assert "\x1b[2J" not in text
    assert "\x1b]" not in text
    assert "\u202e" not in text


PLUG_IN = """
class Raises:
    def __str__(self):
        raise RuntimeError

def __getattr__(name):
    raise {error}({message})
"""


@pytest.mark.parametrize("error", ["ValueError", "KeyError", "ConnectionError"])
@pytest.mark.parametrize("message", [repr(HOSTILE), repr("a\nb\x1bc"), "Raises()", ""])
def test_the_message_of_a_plug_in_is_one_plain_line(error, message, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(tmp_path)
    module = f"raising{abs(hash((error, message)))}"
    (tmp_path / f"{module}.py").write_text(PLUG_IN.format(error=error, message=message))
    assert main(["systems", f"{module}:Mine"]) in (1, 2)
    told = capsys.readouterr().err
    assert told.startswith("pinnobs: error: ")
    assert told.count("\n") == 1
    assert is_plain(told)


def test_warnings_and_the_log_are_plain(capsys, monkeypatch):
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    show_messages_printable()
    show_messages_printable()  # a second command in a process
    told = warnings.formatwarning(HOSTILE, UserWarning, "file.py", 1)
    assert f"UserWarning: {SEEN}" in told
    assert is_plain(told)
    logging.lastResort.handle(logging.LogRecord("x", 30, "", 0, f"{HOSTILE}\n2", None, None))
    assert capsys.readouterr().err == f"{SEEN}\n2\n"


def test_of_a_long_message_both_ends_are_told(capsys):
    assert main(["x" * 5000]) == 2
    told = capsys.readouterr().err
    assert len(told) < 1100
    assert told.startswith("pinnobs: error: unknown command 'xxx")
    assert told.rstrip().endswith(", tune")


def test_a_file_that_cannot_be_opened_is_named(capsys, tmp_path):
    name = "a" * 300
    assert main(["tables", str(tmp_path / name)]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"pinnobs: error: {tmp_path / name}: ")
    assert told.count("\n") == 1
