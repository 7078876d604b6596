"""Update the README's pictures, and the tables of docs/results.md, from stored scores.

    python scripts/readme.py [--rows-file published]
        [--conditions-file runs/conditions/rows.jsonl]
        [--paper-file runs/paper/results.jsonl] [--comparison-file runs/paper/comparison.md]
        [--figures docs/figures]

The leaderboard, of the published rows, goes to the README as a picture and to docs/results.md as
tables, the other tables to docs/results.md, and all measured figures to docs/benchmarks.md.
Sections without stored scores are left unchanged.
"""

from __future__ import annotations

import platform
import sys
from collections.abc import Mapping
from pathlib import Path

import measured
import tyro
from machine import processor
from matplotlib.figure import Figure
from reproduction import report as paper
from reproduction.tables import TABLES

from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.figures import ESTIMATE, TRUE, plain, state_figure
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.files import replacing
from pinnobs_gym.leaderboard import ranks_table
from pinnobs_gym.leaderboard.board import Board, Part, board
from pinnobs_gym.leaderboard.chapters import chapters
from pinnobs_gym.leaderboard.grid import text_table
from pinnobs_gym.leaderboard.published.reading import PUBLISHED, load_rows
from pinnobs_gym.scoring import rows

ROOT = Path(__file__).parents[1]
END = "<!-- end -->"


def picture(path: Path, seed: int = 3) -> None:
    """Draw the EKF's estimates of one episode of ReverseDuffing."""
    source = EpisodeSource("ReverseDuffing")
    episodes = source.play(source.draw(source.streams([seed])))
    record = source.record(episodes)
    estimates = EKF.for_setup(source.system, source.setup).run(record)
    assert estimates.P is not None
    figure = state_figure(
        source.system,
        record.t,
        estimates.xhat[0],
        x=episodes.x[:-1, 0],
        y=record.y[0],
        P=estimates.P[0],
        title="ReverseDuffing: x2 is estimated from noisy x1 (band: two standard deviations)",
    )
    write_figure(path, figure)


def leaderboard_picture(path: Path, part: Part) -> None:
    """Draw the factor of each estimator to the peer in the steady window, with its interval and
    rank, those that see the whole record first below the others."""
    shown = [line for line in part.lines if "steady" in line.places]
    height, largest = 1.0 + 0.22 * len(shown), 30.0
    figure = Figure(figsize=(9, height))
    panel = figure.add_axes((0.36, 0.5 / height, 0.61, 1 - 0.85 / height))
    for y, line in enumerate(shown):
        place = line.places["steady"]
        low, value, high = (
            min(each, largest) for each in (place.factor.low, place.factor.value, place.factor.high)
        )
        colour = ESTIMATE if line.track == "online" else "#4a6fa5"
        panel.plot([low, high], [y, y], color=colour, lw=2, alpha=0.5)
        panel.plot(value, y, ">" if place.factor.value > largest else "o", color=colour, ms=5)
    ranks = [line.places["steady"].rank for line in shown]
    names = [
        f"{plain(line.estimator)}  {'–' if rank is None else rank}"
        for line, rank in zip(shown, ranks, strict=True)
    ]
    panel.set_yticks(range(len(shown)), names, fontsize=8)
    panel.set_ylim(len(shown) - 0.4, -0.6)
    panel.set_xscale("log")
    panel.axvline(1.0, color=TRUE, lw=0.8)
    panel.grid(axis="x", alpha=0.3, which="both")
    panel.set_xlabel(f"steady error over that of {plain(part.places.peer)}, 95 % interval")
    panel.set_title(
        f"Rank and error over {len(shown[0].games)} systems (blue: see the whole record; "
        f"▸: beyond {largest:g})",
        fontsize=10,
    )
    write_figure(path, figure)


def measured_on(scored: list[rows.Row]) -> str:
    """Return when and how the leaderboard was measured."""
    dates = sorted(row["date"][:10] for row in scored)
    seeds = {row["training_seed"] for row in scored if not row["training"].get("per_record")}
    trainings = len(seeds - {None})
    return (
        f"Measured on {dates[-1]} with Python {platform.python_version()}, one thread a job "
        f"({processor()}), {trainings} trainings of each estimator that is trained before. "
        "`pinnobs tables published` prints the details of each system."
    )


def summary(scored: list[rows.Row], found: Board) -> str:
    """Return the tables of estimators across the systems: of those that are made before any record
    is seen, and of those that are trained on each."""
    parts = [measured_on(scored)]
    for chapter in chapters(found):
        if chapter.key.endswith("overview"):
            grid = chapter.tables[0][0][0]
            parts += [chapter.note, text_table(grid.header, grid.lines)]
    return "\n\n".join(parts)


def under_conditions(scored: list[rows.Row]) -> str:
    """Return the table of ranks under every condition."""
    episodes = len({row["episode"] for row in scored})
    intro = (
        "Estimators that need no training under every condition, by `pinnobs leaderboard "
        f"--condition all --episodes {episodes}`."
    )
    part = board(rows.Stored(scored, [])).main
    grid = ranks_table.rank_grid(part.conditions, part.knows)
    table = text_table(grid.header, grid.lines)
    return "\n\n".join(filter(None, [intro, ranks_table.RANK_NOTE, table, grid.note]))


def replaced(text: str, name: str, content: str) -> str:
    """Replace the content between the marks of a name, which the text has to have."""
    start = f"<!-- {name}: written by scripts/readme.py -->"
    before, mark, rest = text.partition(start)
    assert mark, start
    after = rest.partition(END)[2]
    return f"{before}{start}\n\n{content}\n\n{END}{after}"


def _rewrite(path: Path, sections: Mapping[str, str]) -> None:
    """Replace the sections of a file that have content."""
    text = path.read_text(encoding="utf-8")
    for name, content in sections.items():
        text = replaced(text, name, content) if content else text
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def main(
    rows_file: Path = PUBLISHED,
    paper_file: Path = ROOT / "runs/paper/results.jsonl",
    conditions_file: Path = ROOT / "runs/conditions/rows.jsonl",
    comparison_file: Path = ROOT / "runs/paper/comparison.md",
    figures: Path = ROOT / "docs/figures",
) -> int:
    """Rewrite the picture and the tables.

    Args:
        rows_file: the leaderboard's scores, or ``published`` for those of the package.
        paper_file: the results of reproduce_paper.py.
        conditions_file: scores under every condition.
        comparison_file: the table that reproduce_paper.py comparison wrote.
        figures: folder of the output of benchmark.py, a file of each group.
    """
    scored = load_rows([rows_file]).rows
    section = paper.readme_section(paper.read(paper_file), TABLES.values())
    found = measured.read(figures)
    compared = comparison_file.read_text(encoding="utf-8") if comparison_file.exists() else ""
    everywhere = rows.read(conditions_file)
    if not (scored or everywhere or section or compared or found):
        print(
            f"nothing in {rows_file}, {paper_file} or {figures}; run make publish, "
            "reproduce_paper.py or benchmark.py",
            file=sys.stderr,
        )
        return 2
    tables = ""
    if scored:
        found_board = board(rows.Stored(scored, []))
        picture(ROOT / "docs" / "reverse_duffing.png")
        leaderboard_picture(ROOT / "docs" / "leaderboard.png", found_board.main)
        _rewrite(ROOT / "README.md", {"leaderboard": measured_on(scored)})
        tables = summary(scored, found_board)
    sections = {
        "leaderboard": tables,
        "conditions": under_conditions(everywhere) if everywhere else "",
        "paper": section,
        "comparison": compared.partition("\n\n")[2].strip(),  # under the page's own heading
        "figures": measured.readme_section(found) if found else "",
    }
    _rewrite(ROOT / "docs" / "results.md", sections)
    if found:
        with replacing(ROOT / "docs" / "benchmarks.md") as temporary:
            temporary.write_text(measured.page(found), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
