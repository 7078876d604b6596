"""What the commands print and log of the scores of one estimator on one system."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from pinnobs_gym.cli.console import console, print_table, progress
from pinnobs_gym.envs.game import AnyGame
from pinnobs_gym.leaderboard import standings_table
from pinnobs_gym.leaderboard.against import Opponents, compare
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.escapes import quoted
from pinnobs_gym.leaderboard.floor import floors, is_floor
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.leaderboard.states_table import by_state
from pinnobs_gym.leaderboard.tables import tables
from pinnobs_gym.scoring import rows as rows_module
from pinnobs_gym.scoring.evaluation import Evaluated
from pinnobs_gym.scoring.rows import Row
from pinnobs_gym.scoring.tensorboard import log_episodes, log_folder, log_summary
from pinnobs_gym.training.log import Log


def rows_file(out: Path) -> Path:
    """Return the rows file in an output folder."""
    return out / "rows.jsonl"


def with_progress(
    episodes: int, score: Callable[..., Evaluated], phases: bool = False
) -> Evaluated:
    """Return the result of ``score``, which is given a function to call after each batch with its
    number of episodes, and show a progress bar meanwhile. If it has phases, its argument ``phase``
    is a function to call with what it does."""
    with progress() as bar:
        task = bar.add_task("episodes", total=episodes)

        def count(done: int) -> None:
            bar.advance(task, done)

        def phase(doing: str) -> None:
            bar.update(task, description=f"episodes: {doing}")

        evaluated = score(count, phase=phase) if phases else score(count)
        bar.update(task, completed=episodes, description="episodes")
    return evaluated


def report(
    game: AnyGame,
    evaluated: Evaluated,
    out: Path,
    picture: bool = True,
    others: Opponents | None = None,
    shipped: Sequence[Row] = (),
) -> None:
    """Print the tables of scored episodes, and log them for TensorBoard.

    Args:
        game: what was played.
        evaluated: the episodes.
        out: the output folder.
        picture: whether to log a picture of the first one, which takes as long as all else of one
            episode.
        others: scores among which they are shown, if any.
        shipped: the published floors of the game.
    """
    rows = rows_file(out)
    if evaluated.reused:
        console.print(evaluated.reuse(rows), soft_wrap=True, highlight=False)
    if others is None:
        known = [row for row in rows_module.read(rows) if rows_module.game_of(row) == game.name]
        found = floors([*evaluated.rows, *filter(is_floor, known)], shipped)
        for table in tables(contenders(runs_of(evaluated.rows, found)), floors=found):
            hint = f"pinnobs tables {quoted(str(rows))} -o FILE writes all"
            print_table(standings_table.layouts(table), hint)
        for note in found.notes:
            console.print(note, style="yellow", soft_wrap=True)
    else:
        comparison = compare(evaluated.rows, others)
        files = dict.fromkeys(quoted(str(path)) for path in (rows, others.path))
        hint = f"pinnobs tables {' '.join(files)} -o FILE writes all"
        print_table(standings_table.layouts(comparison.table), hint)
        console.print(comparison.summary + "\n", highlight=False)
    print_table([[by_state(game.source.system, evaluated.rows)]])
    drawn = evaluated.first_played if picture else None
    with Log(log_folder(out, evaluated.rows[0])) as log:
        log_episodes(log, evaluated.rows, drawn)
        log_summary(log, evaluated.rows)
    console.print(f"rows: {rows}; TensorBoard: {out / 'tensorboard'}", soft_wrap=True)
