"""Scores of code that was edited since never come back."""

import json

import pytest
from edited import write
from new_process import run_script

WHAT = ["--systems", "plant:Oscillator", "--estimators", "mine:Obs"]
EVALUATE = ["evaluate", "--system", "plant:Oscillator", "--estimator", "mine:Obs"]
CALLS = {
    "evaluate": [*EVALUATE, "--episodes", "3"],
    "fresh": [*EVALUATE, "--episodes", "3", "--fresh"],
    "leaderboard": ["leaderboard", *WHAT, "--episodes", "3", "--jobs", "1"],
    "python": """
import logging
from pinnobs_gym import evaluate
from mine import Obs
from plant import Oscillator
from pinnobs_gym.envs.registration import env_id
evaluate(Obs, env_id(Oscillator), episodes=3, results="out/rows.jsonl")
""",
}


def scores(folder, call):
    """The rows after a call in a new process, and whether it says that it took some from there."""
    text = CALLS[call]
    if not isinstance(text, str):
        text = f"from pinnobs_gym.cli import main\nassert main({[*text, '--out', 'out']!r}) == 0"
    said = "".join(run_script(text, folder))
    lines = (folder / "out" / "rows.jsonl").read_text().splitlines()
    return [json.loads(line) for line in lines], [x for x in said.splitlines() if "taken" in x]


@pytest.mark.parametrize(
    ("call", "edit"), [("evaluate", "a helper module"), ("leaderboard", "f"), ("python", "h")]
)
def test_after_an_edit_everything_is_scored_anew(tmp_path, call, edit):
    write(tmp_path)
    first, taken = scores(tmp_path, call)
    assert (len(first), taken) == (3, [])
    write(tmp_path, "a comment")
    same, taken = scores(tmp_path, call)
    assert same == first
    (said,) = taken
    assert said.startswith("3 of 3 episodes taken from ")
    assert said.endswith("rows.jsonl")
    write(tmp_path, edit)
    both, taken = scores(tmp_path, call)
    assert taken == []
    assert both[:3] == first
    assert len(both) == 6
    assert not {row["nrmse"] for row in both[3:]} & {row["nrmse"] for row in first}


def test_fresh_scores_replace_those_that_are_stored(tmp_path):
    write(tmp_path)
    first, _ = scores(tmp_path, "evaluate")
    again, taken = scores(tmp_path, "fresh")
    assert taken == []
    assert [row["nrmse"] for row in again] == [row["nrmse"] for row in first]
    assert all(a["date"] > b["date"] for a, b in zip(again, first, strict=True))


@pytest.mark.parametrize("edit", ["f", "a helper module"])
def test_after_an_edit_is_reverted_the_tables_show_the_present_code(tmp_path, edit):
    """Its scores are taken from the file, in which those of the edit are later."""
    write(tmp_path)
    scores(tmp_path, "leaderboard")
    first = (tmp_path / "out" / "leaderboard.md").read_text()
    write(tmp_path, edit)
    scores(tmp_path, "leaderboard")
    edited = (tmp_path / "out" / "leaderboard.md").read_text()
    write(tmp_path, "a comment")
    stored, (said,) = scores(tmp_path, "leaderboard")
    assert said.startswith("3 of 3 episodes")
    assert [row["kind"] for row in stored[6:]] == ["use"]
    again = (tmp_path / "out" / "leaderboard.md").read_text()

    def cells(text):
        """The line of the estimator in the table of the game, without its cost."""
        lines = text.partition("# Each game")[2].splitlines()
        (line,) = (line.split(" | ") for line in lines if " | obs | " in line)
        return line[:6]

    assert cells(again) == cells(first) != cells(edited)
    scores(tmp_path, "leaderboard")
    assert (tmp_path / "out" / "leaderboard.md").read_text() == again
    assert len((tmp_path / "out" / "rows.jsonl").read_text().splitlines()) == 7  # said once
