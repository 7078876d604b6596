"""What the command ``leaderboard`` prints and writes at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pinnobs_gym.cli.console import console, print_table
from pinnobs_gym.files import replacing
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.chapters import chapters, markdown
from pinnobs_gym.scoring.rows import Row, Stored


def report(stored: Stored, shipped: Sequence[Row], conditions: set[str], out: Path) -> None:
    """Print and write the tables, and print where everything is.

    Args:
        stored: the content of the rows file.
        shipped: the published floors.
        conditions: those that were played.
        out: folder of the leaderboard.
    """
    results = board(stored, shipped)
    path = out / "leaderboard.md"
    hint = f"{path} has all"
    found = chapters(results)
    for chapter in found[::-1]:  # the overview last, where it is seen
        wanted = [
            layouts
            for i, layouts in enumerate(chapter.tables)
            if not chapter.games or chapter.games[i].game.condition in conditions
        ]
        if not wanted or (chapter.games and len(conditions) > 2):
            continue
        for layouts in wanted:
            print_table(layouts, hint)
        console.print(chapter.note + "\n", highlight=False)
    for note in results.notes:
        console.print(note, style="yellow", soft_wrap=True)
    with replacing(path) as temporary:
        temporary.write_text(markdown(results), encoding="utf-8")
    for what, where in (
        ("tables", path),
        ("rows", out / "rows.jsonl"),
        ("TensorBoard", out / "tensorboard"),
        ("trained files", out / "trained"),
    ):
        if where.exists():
            console.print(f"{what + ':':14} {where}", soft_wrap=True)


def say_outdated(outdated: Mapping[str, Sequence[str]]) -> None:
    """Print which published trainings are of earlier code, if any are: systems by estimator."""
    if outdated:
        found = "; ".join(f"{name} on {', '.join(systems)}" for name, systems in outdated.items())
        console.print(
            f"trained by earlier code: {found}; --retrain trains anew",
            style="yellow",
            soft_wrap=True,
        )
