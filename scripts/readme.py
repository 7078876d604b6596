"""Update the README's picture and tables from stored scores.

    python scripts/readme.py [--rows-file runs/leaderboard/rows.jsonl]
        [--conditions-file runs/conditions/rows.jsonl]
        [--paper-file runs/paper/results.jsonl] [--comparison-file runs/paper/comparison.md]
        [--figures-file runs/benchmark.jsonl]

All measured figures go to docs/benchmarks.md, and a summary of them to the README. Sections without
stored scores are left unchanged.
"""

from __future__ import annotations

import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

import measured
import tyro
from machine import processor
from reproduction import report as paper
from reproduction.tables import TABLES

from pinnobs_gym.cli.output import write_figure
from pinnobs_gym.envs.episodes import EpisodeSource
from pinnobs_gym.envs.figures import state_figure
from pinnobs_gym.estimators.ekf import EKF
from pinnobs_gym.files import replacing
from pinnobs_gym.leaderboard import ranks, ranks_table
from pinnobs_gym.leaderboard.board import board
from pinnobs_gym.leaderboard.contenders import contenders
from pinnobs_gym.leaderboard.grid import text_table
from pinnobs_gym.leaderboard.runs import runs_of
from pinnobs_gym.scoring import rows

ROOT = Path(__file__).parents[1]
END = "<!-- end -->"
PAPER_HEADING = "## The paper's figures"
CONDITIONS_HEADING = "### Under every condition"
COMPARISON_HEADING = "### Beside the learned observers"
FIGURES_HEADING = "## Measured figures"
BEFORE = "## Development"
"""Heading before which new sections are inserted."""


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


def summary(scored: list[rows.Row]) -> str:
    """Return the table of estimators across the systems, and the table of ranks if there is one."""
    date = datetime.now(UTC).date().isoformat()
    intro = (
        f"Measured on {date} with Python {platform.python_version()}, one thread a job "
        f"({processor()}), by `make leaderboard`, which writes the details of each system to "
        "`runs/leaderboard/leaderboard.md`."
    )
    standings = board(rows.Stored(scored, []))
    overview = ranks_table.grid(standings.lines)
    parts = [intro, ranks_table.NOTE, text_table(overview.header, overview.lines)]
    if len(standings.ranks) > 2:
        placed = ranks_table.rank_grid(standings.ranks)
        parts += [ranks_table.RANK_NOTE, text_table(placed.header, placed.lines)]
    return "\n\n".join(parts)


def under_conditions(scored: list[rows.Row]) -> str:
    """Return the table of ranks under every condition."""
    episodes = len({row["episode"] for row in scored})
    intro = (
        "Estimators that need no training under every condition, by `pinnobs leaderboard "
        f"--condition all --episodes {episodes}`."
    )
    ratios = ranks.log_ratios(contenders(runs_of(scored)))
    placed = ranks_table.rank_grid(ranks.ranks(ratios))
    table = text_table(placed.header, placed.lines)
    return "\n\n".join([intro, ranks_table.RANK_NOTE, table])


def replaced(text: str, name: str, content: str, heading: str) -> str:
    """Replace the content between the marks of a name.

    If the text has no such marks, they are inserted, under the heading, before `BEFORE`.
    """
    start = f"<!-- {name}: written by scripts/readme.py -->"
    if start not in text:
        text = text.replace(BEFORE, f"{heading}\n\n{start}\n{END}\n\n{BEFORE}", 1)
    before, _, rest = text.partition(start)
    after = rest.partition(END)[2]
    return f"{before}{start}\n\n{content}\n\n{END}{after}"


def main(
    rows_file: Path = ROOT / "runs/leaderboard/rows.jsonl",
    paper_file: Path = ROOT / "runs/paper/results.jsonl",
    conditions_file: Path = ROOT / "runs/conditions/rows.jsonl",
    comparison_file: Path = ROOT / "runs/paper/comparison.md",
    figures_file: Path = ROOT / "runs/benchmark.jsonl",
) -> int:
    """Rewrite the picture and the tables.

    Args:
        rows_file: the leaderboard's scores.
        paper_file: the results of reproduce_paper.py.
        conditions_file: scores under every condition.
        comparison_file: the table that reproduce_paper.py comparison wrote.
        figures_file: output of benchmark.py.
    """
    scored = rows.read(rows_file)
    section = paper.readme_section(paper.read(paper_file), TABLES.values())
    figures = measured.read(figures_file)
    compared = comparison_file.read_text(encoding="utf-8") if comparison_file.exists() else ""
    everywhere = rows.read(conditions_file)
    if not (scored or everywhere or section or compared or figures):
        print(
            f"nothing in {rows_file}, {paper_file} or {figures_file}; run make leaderboard, "
            "reproduce_paper.py or benchmark.py",
            file=sys.stderr,
        )
        return 2
    readme = ROOT / "README.md"
    text = readme.read_text(encoding="utf-8")
    if scored:
        picture(ROOT / "docs" / "reverse_duffing.png")
        text = replaced(text, "leaderboard", summary(scored), "## Leaderboard")
    if section:
        text = replaced(text, "paper", section, PAPER_HEADING)
    if everywhere:
        text = replaced(text, "conditions", under_conditions(everywhere), CONDITIONS_HEADING)
    if compared:
        table = compared.partition("\n\n")[2].strip()  # under the README's own heading
        text = replaced(text, "comparison", table, COMPARISON_HEADING)
    if figures:
        text = replaced(text, "figures", measured.readme_section(figures), FIGURES_HEADING)
        with replacing(ROOT / "docs" / "benchmarks.md") as temporary:
            temporary.write_text(measured.page(figures), encoding="utf-8")
    with replacing(readme) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
