"""The bar of a training, at the width of the terminal."""

import re

import pytest
from rich.console import Console

from pinnobs_gym.training import progress


@pytest.mark.parametrize("width", [60, 80, 110, 200])
def test_only_the_words_of_a_bar_are_cut(width, monkeypatch, capsys):
    monkeypatch.setattr(
        "rich.progress.get_console", lambda: Console(width=width, force_terminal=True)
    )
    words = "412 iterations, initial 1.05e-03 equation 3.10e-04 output 2.2e-05 best 1.2e-4"
    with progress._bar() as show:
        show(0.3, words)
    line = re.split(r"[\r\n]", re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", capsys.readouterr().out))
    last = [part for part in line if "30 %" in part][-1]
    assert len(last.rstrip()) <= width
    assert re.search(r"30 % 0:00:0\d so far, [-\d:]+ left", last)
    assert words[:9] in last
    assert (words in last) == (width == 200)
